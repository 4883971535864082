"""Mutation testing: single changes of meaning, and whether any test notices them.

Each mutant is a copy of the package with one operator, condition or number changed, drawn with a
seed; the tests are those that run the changed line. One that no test kills says what nothing tests
(DeMillo, Lipton and Sayward: Hints on test data selection, Computer 1978). Mutants that change no
result are listed in equivalent_mutants.txt beside this file.
"""

from __future__ import annotations

import argparse
import ast
import copy
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from covering_tests import PACKAGE, REPORT, ROOT, CoveringTests
from scipy.stats import binom

EQUIVALENT = Path(__file__).with_name('equivalent_mutants.txt')
# Probability below which a share of dead mutants is no chance.
CHANCE = 0.01
_DRAWS = {'choice', 'integers', 'normal', 'one_of', 'uniform'}
_SWAPS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}


class Mutant(NamedTuple):
    """A change of the lines `first` to `last` of a file to `text`."""

    path: Path
    first: int
    last: int
    before: str
    after: str
    text: str

    @property
    def name(self) -> str:
        """Tells it from others, wherever it moves in its file."""
        return f'{self.path.relative_to(ROOT)}: {self.before} -> {self.after}'


def mutants(path: Path) -> Iterator[Mutant]:
    """All mutants of a module."""
    source = path.read_text()
    lines = source.splitlines(keepends=True)
    tree = ast.parse(source)
    for node in _expressions(tree):
        for changed in _changes(node):
            # Columns count bytes.
            first, last = lines[node.lineno - 1].encode(), lines[node.end_lineno - 1].encode()
            text = first[: node.col_offset].decode() + f'({ast.unparse(changed)})'
            text += last[node.end_col_offset :].decode()
            before, after = ast.unparse(node), ast.unparse(changed)
            if isinstance(node, ast.Constant):
                # A number alone does not tell which it is.
                before, after = lines[node.lineno - 1].strip(), text.strip()
            yield Mutant(path, node.lineno, node.end_lineno, before, after, text)


def _expressions(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions that are run: no annotation, decorator, part of a string or docstring."""
    for name, value in ast.iter_fields(tree):
        if name in ('annotation', 'returns', 'decorator_list'):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            # A size that is drawn is as good as another.
            if isinstance(child, ast.Call) and getattr(child.func, 'attr', '') in _DRAWS:
                continue
            # zip() asserts that its arguments are of one length.
            if isinstance(child, ast.keyword) and child.arg == 'strict':
                continue
            if isinstance(child, ast.expr):
                yield child
            yield from _expressions(child)


def _changes(node: ast.expr) -> Iterator[ast.expr]:
    if isinstance(node, ast.Compare):
        for place, operator in enumerate(node.ops):
            if type(operator) in _SWAPS:
                changed = copy.deepcopy(node)
                changed.ops[place] = _SWAPS[type(operator)]()
                yield changed
    elif isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in _SWAPS:
        changed = copy.deepcopy(node)
        changed.op = _SWAPS[type(node.op)]()
        yield changed
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        # One more is little of a large number.
        yield ast.Constant(node.value + 1 if abs(node.value) <= 10 else 2 * node.value)


def run(
    tests: list[str], limit: float, root: str, mutant: Mutant | None = None
) -> tuple[str, str]:
    """What tests say within `limit` seconds of a copy in `root`, and which failed first."""
    folder = tempfile.mkdtemp(dir=root)
    left_out = shutil.ignore_patterns('.git', '.venv*', 'site', 'demo')
    shutil.copytree(ROOT, folder, ignore=left_out, dirs_exist_ok=True)
    if mutant:
        target = Path(folder, mutant.path.relative_to(ROOT))
        lines = target.read_text().splitlines(keepends=True)
        lines[mutant.first - 1 : mutant.last] = [mutant.text]
        target.write_text(''.join(lines))
    command = [sys.executable, '-m', 'pytest', '-x', '-q', '-n', '0', '--no-header', *tests]
    environment = {**os.environ, 'PYTHONPATH': folder, 'PYTHONDONTWRITEBYTECODE': '1'}
    environment.pop('NUMBA_CACHE_DIR', None)
    with tempfile.TemporaryFile('w+') as output:
        try:
            code = subprocess.run(
                command,
                cwd=folder,
                env=environment,
                stdout=output,
                stderr=output,
                timeout=limit,
                start_new_session=True,
            ).returncode
        except subprocess.TimeoutExpired:
            return 'timeout', ''
        finally:
            end_processes(folder)
            shutil.rmtree(folder, ignore_errors=True)
        output.seek(0)
        failed = re.search(r'^(?:FAILED|ERROR) (.+?)(?: - |$)', output.read(), re.MULTILINE)
    if code < 0 or code >= 128:
        return 'crashed', ''
    kinds = {0: 'survived', 5: 'untested'}
    return kinds.get(code, 'killed'), failed[1] if failed else ''


def end_processes(folder: str) -> None:
    """End those that came of tests in a folder, which they have in their environment.

    What compiles has a session of its own, and would go on.
    """
    for environment in Path('/proc').glob('[0-9]*/environ'):
        with suppress(OSError):
            if os.fsencode(folder) in environment.read_bytes():
                os.kill(int(environment.parent.name), signal.SIGKILL)


def main() -> int:
    """Draw mutants, run their tests, and print what became of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--count', type=int, default=300, help='mutants to draw')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--seconds', type=float, default=60, help='of tests for each, about')
    parser.add_argument('--name', default='', help='of names (path: before -> after): a pattern')
    parser.add_argument('--least', type=float, default=0.85, help='share that is to die')
    parser.add_argument('--limit', type=float, default=200, help='seconds for one')
    parser.add_argument('--jobs', type=int, default=1, help='mutants at the same time')
    parser.add_argument('--minutes', type=float, default=math.inf, help='begin none after that')
    chosen = parser.parse_args()
    known = {
        line.partition(' # ')[0] for line in EQUIVALENT.read_text().splitlines() if line[:1] != '#'
    }
    every = [
        mutant
        for path in sorted(PACKAGE.rglob('*.py'))
        for mutant in mutants(path)
        if mutant.name not in known and re.search(chosen.name, mutant.name)
    ]
    drawn = random.Random(chosen.seed).sample(every, min(chosen.count, len(every)))
    if not REPORT.exists():
        parser.error('which tests run which line is not known: make test COVERAGE=1')
    covering = CoveringTests()
    end = time.monotonic() + 60 * chosen.minutes
    place = tempfile.TemporaryDirectory(prefix='mutants-', ignore_cleanup_errors=True)

    def stop(number: int, frame: object) -> None:
        """Begin no more, and end what runs: the table is of those that are done."""
        nonlocal end
        end = -math.inf
        end_processes(place.name)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)

    @cache
    def passes(test: str) -> bool:
        """Whether a test passes where nothing is changed."""
        return run([test], chosen.limit, place.name)[0] == 'survived'

    def judged(mutant: Mutant) -> str:
        if time.monotonic() > end:
            return 'no time'
        outcome, failed = 'untested', ''
        if tests := covering.of(mutant.path, mutant.first, mutant.last, chosen.seconds):
            outcome, failed = run(tests, chosen.limit, place.name, mutant)
        if outcome == 'killed' and failed and not passes(failed):
            outcome = 'unsound'
        if end == -math.inf:
            return 'no time'
        print(f'{outcome:9}{mutant.name}  (line {mutant.first}) {failed}', flush=True)
        return outcome

    with place, ThreadPoolExecutor(chosen.jobs) as pool:
        outcomes = list(pool.map(judged, drawn))
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for mutant, outcome in zip(drawn, outcomes, strict=True):
        if outcome != 'no time':
            table[mutant.path.relative_to(PACKAGE).parts[0]][outcome] += 1
    total: Counter[str] = Counter()
    kinds = ('killed', 'crashed', 'timeout', 'survived', 'untested', 'unsound')
    print(f'\n{"":20}' + ''.join(f'{kind:>10}' for kind in kinds))
    for part, counts in sorted(table.items()):
        print(f'{part:20}' + ''.join(f'{counts[kind]:10}' for kind in kinds))
        total += counts
    dead, count = sum(total[kind] for kind in kinds[:3]), total.total()
    print(
        f'{dead} of {count} mutants die (seed {chosen.seed}, {len(drawn)} drawn of {len(every)})'
    )
    # Few of them tell little: it fails where so few are no chance.
    return bool(binom.cdf(dead, count, chosen.least) < CHANCE)


if __name__ == '__main__':
    sys.exit(main())
