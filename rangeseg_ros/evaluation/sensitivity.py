"""How far a constant of the core may move before results get worse.

A constant is compiled into the kernels that read it, and into those that call them. So each trial
runs `rangeseg evaluate` on all sets, and a program of one's own, in a copy of the package in which
those expressions are changed, with all compiled code: the copy sees which of it is outdated.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rangeseg_ros.digest import code_digest
from rangeseg_ros.io.files import replacing

PACKAGE = Path(__file__).parents[1]
TOLERATED_LOSS = 0.003
"""Mean IoU, or another share, that a constant may cost within its range."""
_FOUND = 'ground_kept', 'obstacle_found', 'drop_found'


class Constant(NamedTuple):
    """A number, or some, in capitals at the top level of a module of the core.

    Attributes
    ----------
    module : str
        Below core/, e.g. `by_planes/patches`.
    name : str
    value : number or tuple of numbers
    source : str
        The expression that gives it.
    """

    module: str
    name: str
    value: Any
    source: str

    def __str__(self) -> str:
        return f'{self.module}.{self.name}'


def find_constants() -> list[Constant]:
    """All constants of the core, in the order of its modules and lines."""
    found = []
    for path in sorted((PACKAGE / 'core').rglob('*.py')):
        module = path.relative_to(PACKAGE / 'core').with_suffix('').as_posix()
        text = path.read_text(encoding='utf-8')
        for name, node in _assigned(ast.parse(text)):
            value = getattr(importlib.import_module(_dotted(path)), name)
            if name.isupper() and _is_numeric(value):
                found.append(Constant(module, name, value, ast.unparse(node)))
    return found


def _assigned(tree: ast.Module) -> list[tuple[str, ast.expr]]:
    """Names and expressions of the top-level assignments; of tuples, element by element."""
    pairs = []
    for statement in tree.body:
        if not isinstance(statement, ast.Assign):
            continue
        (target,), value = statement.targets, statement.value
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs += list(zip(target.elts, value.elts, strict=True))
        else:
            pairs.append((target, value))
    return [(target.id, value) for target, value in pairs if isinstance(target, ast.Name)]


def _is_numeric(value: Any) -> bool:
    if type(value) is tuple:
        return len(value) > 0 and all(_is_numeric(entry) for entry in value)
    return isinstance(value, int | float) and not isinstance(value, bool)


def _dotted(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def write_changed(constants: Sequence[Constant], factor: float, folder: Path) -> None:
    """Copy the package into `folder`, these constants in it `factor` times as large."""
    shutil.copytree(PACKAGE, folder / PACKAGE.name)
    for constant in constants:
        path = folder / PACKAGE.name / 'core' / f'{constant.module}.py'
        text = path.read_text(encoding='utf-8')
        lines = text.splitlines(keepends=True)
        node = dict(_assigned(ast.parse(text)))[constant.name]
        assert node.end_lineno is not None and node.end_col_offset is not None
        start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
        end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
        changed = repr(_scaled(constant.value, factor))
        path.write_text(text[:start] + changed + text[end:], encoding='utf-8')


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_scaled(entry, factor) for entry in value)
    return round(value * factor) if isinstance(value, int) else value * factor


@dataclass(frozen=True)
class Trial:
    """Constants times a factor, on some sets; `factor` 1 is the package as it is.

    Attributes
    ----------
    constants : tuple of Constant
        One, or several that are moved together.
    factor : float
    folders : tuple of Path
        Sets that `rangeseg evaluate` knows.
    arguments : tuple of str
        More of its arguments.
    cache : Path
        Folder of finished trials: what is there is not done again.
    script : Path, optional
        A Python program that measures the package that it imports, and prints an object of JSON:
        names of figures, 1 at best.
    """

    constants: tuple[Constant, ...]
    factor: float
    folders: tuple[Path, ...]
    arguments: tuple[str, ...]
    cache: Path
    script: Path | None = None

    def run(self) -> dict[str, float] | None:
        """How good each set is, by its path, and what the script says; None where either fails.

        Of a set that is the mean IoU at tolerance 0.8, of terrains the mean of what is found of
        ground, obstacles and drops.
        """
        path = self.cache / f'{self._key()}.json'
        if not path.exists():
            figures = self._measure()
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as partial:
                partial.write_text(json.dumps(figures))
        found: dict[str, float] | None = json.loads(path.read_text())
        return found

    def _measure(self) -> dict[str, float] | None:
        with tempfile.TemporaryDirectory() as temporary:
            copy, result = Path(temporary), Path(temporary, 'figures.json')
            write_changed(self.constants, self.factor, copy)
            environment = {**os.environ, 'PYTHONPATH': str(copy)}
            environment.pop('NUMBA_CACHE_DIR', None)

            def python(*words: str) -> bytes:
                command = [sys.executable, *words]
                return subprocess.run(
                    command, env=environment, cwd=copy, capture_output=True, check=True
                ).stdout

            code = 'from rangeseg_ros.cli.main import main; main()'
            evaluate = ['-c', code, 'evaluate', '--jobs', '1', '--tolerance', '0.8']
            evaluate += ['--json', str(result), *self.arguments]
            found: dict[str, float] = {}
            try:
                for folder in self.folders:
                    python(*evaluate, str(folder.resolve()))
                    found[str(folder)] = _quality(json.loads(result.read_text()))
                if self.script:
                    found |= json.loads(python(str(self.script.resolve())))
            except (subprocess.CalledProcessError, ValueError):
                return None
            return found

    def _key(self) -> str:
        # Without a change, all constants are alike.
        names = '' if self.factor == 1 else ' '.join(map(str, self.constants))
        sets = [str(folder.resolve()) for folder in self.folders]
        script = self.script.read_text() if self.script else ''
        words = names, self.factor, sets, self.arguments, script
        return hashlib.sha256(code_digest() + repr(words).encode()).hexdigest()[:16]


def _quality(figures: dict[str, Any]) -> float:
    if 'pooled' in figures:
        shares = figures['pooled']
        return sum(shares[name] for name in _FOUND) / len(_FOUND)
    return float(figures['tolerances']['0.8']['mean_iou'])


def ranges(
    trials: Sequence[Trial], results: Sequence[dict[str, float] | None]
) -> list[dict[str, Any]]:
    """Of what was moved, the factors around 1 that cost no set more than `TOLERATED_LOSS`.

    Returns
    -------
    list of dict
        `constant` (names), `value` (of each), `low`, `high` (factors), `loss`: the largest of any
        factor tried (1 where the segmenter failed), `set`: where; what matters most first.
    """
    plain = next(r for t, r in zip(trials, results, strict=True) if t.factor == 1 and r)
    losses: dict[tuple[Constant, ...], dict[float, tuple[float, str]]] = {}
    for trial, result in zip(trials, results, strict=True):
        worst = max((plain[name] - result[name], name) for name in plain) if result else (1.0, '')
        losses.setdefault(trial.constants, {})[trial.factor] = worst
    rows = []
    for constants, by_factor in losses.items():
        low = high = 1.0
        for factor in sorted(by_factor):
            if factor > 1 and all(
                by_factor[f][0] <= TOLERATED_LOSS for f in by_factor if 1 < f <= factor
            ):
                high = factor
        for factor in sorted(by_factor, reverse=True):
            if factor < 1 and all(
                by_factor[f][0] <= TOLERATED_LOSS for f in by_factor if factor <= f < 1
            ):
                low = factor
        loss, where = max(by_factor.values())
        rows.append(
            {
                'constant': ', '.join(map(str, constants)),
                'value': ', '.join(str(constant.value) for constant in constants),
                'low': low,
                'high': high,
                'loss': loss,
                'set': where,
            }
        )
    return sorted(rows, key=lambda row: -row['loss'])
