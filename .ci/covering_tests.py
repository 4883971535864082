"""Which tests run a line, as `make test COVERAGE=1` has found it."""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from coverage import CoverageData

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'rangeseg_ros'
DATA, REPORT = ROOT / '.coverage', ROOT / '.coverage.xml'
# What follows the name of a test in a context: of this process, or of one that it starts.
_PHASE = re.compile(r'(\||\s\()(setup|run|call|teardown)\)?$')


class _Scope(NamedTuple):
    """A function, or a definition of a module or class, and whether coverage sees who runs it.

    The name is a regular expression.
    """

    name: str
    first: int
    last: int
    traced: bool


class CoveringTests:
    """The tests of all lines of the package, those that run the fewest lines first.

    Coverage does not see kernels, sees the first call alone of what is cached, and does not see
    who uses what a module or a class defines: those have the tests of functions that name them.
    """

    def __init__(self) -> None:
        data = CoverageData(str(DATA))
        data.read()
        self._tests: dict[Path, dict[int, set[str]]] = {}
        self._lines: Counter[str] = Counter()
        for path in [*PACKAGE.rglob('*.py'), *(ROOT / 'test').glob('*.py')]:
            contexts = data.contexts_by_lineno(str(path))
            self._tests[path] = {
                line: {_PHASE.sub('', name) for name in names if name}
                for line, names in contexts.items()
            }
            for tests in self._tests[path].values():
                self._lines.update(tests)
        self._text = {path: path.read_text().splitlines() for path in self._tests}
        self._scopes = {path: _scopes(path) for path in self._tests}
        self._seconds = {}
        for case in ElementTree.parse(REPORT).iter('testcase'):
            file = case.attrib['classname'].replace('.', '/')
            self._seconds[f'{file}.py::{case.attrib["name"]}'] = float(case.attrib['time'])

    def of(self, path: Path, first: int, last: int, seconds: float) -> list[str]:
        """Tests of the lines `first` to `last`: as many as take `seconds`, or one."""
        scope = self._scope(path, first)
        found: set[str] = set()
        if scope and scope.traced:
            # An operand in a line of its own may have no event.
            found = self._of_lines(path, first, last) or self._of_function(path, scope)
        # Or what a function does as others are defined.
        found = found or self._of_users(scope.name if scope else path.stem)
        chosen: list[str] = []
        for test in sorted(found & self._seconds.keys(), key=lambda t: (self._lines[t], t)):
            if self._seconds[test] < seconds or not chosen:
                chosen.append(test)
                seconds -= self._seconds[test]
        return chosen

    def _of_lines(self, path: Path, first: int, last: int) -> set[str]:
        return set().union(*(self._tests[path].get(n, ()) for n in range(first, last + 1)))

    def _of_function(self, path: Path, scope: _Scope) -> set[str]:
        # The first line is run where it is defined.
        return self._of_lines(path, scope.first + 1, scope.last)

    def _scope(self, path: Path, line: int) -> _Scope | None:
        around = [scope for scope in self._scopes[path] if scope.first <= line <= scope.last]
        return around[-1] if around else None

    def _of_users(self, name: str) -> set[str]:
        """Tests of the functions that use a name, and of those that use what is made with it."""
        found: set[str] = set()
        names = [name]
        for each in names:
            pattern = re.compile(rf'\b({each})\b')
            for path, text in self._text.items():
                for number, line in enumerate(text, 1):
                    scope = self._scope(path, number) if pattern.search(line) else None
                    if scope and scope.traced:
                        found |= self._of_function(path, scope)
                    elif scope and scope.name not in names:
                        names.append(scope.name)
        return found


def _scopes(path: Path) -> list[_Scope]:
    """Those of a module, inner ones last."""
    found = []
    bodies: list[ast.AST] = [ast.parse(path.read_text())]
    for body in bodies:
        for node in ast.iter_child_nodes(body):
            if isinstance(node, ast.FunctionDef):
                decorators = ' '.join(map(ast.unparse, node.decorator_list))
                traced = not re.search('jit|cache', decorators)
                first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
                found.append(_Scope(node.name, first, node.end_lineno, traced))
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                target = node.targets[0] if isinstance(node, ast.Assign) else node.target
                names = [part.id for part in ast.walk(target) if isinstance(part, ast.Name)]
                if not isinstance(body, ast.FunctionDef):
                    found.append(_Scope('|'.join(names), node.lineno, node.end_lineno, False))
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                bodies.append(node)
    return found
