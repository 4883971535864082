"""Ablation: what every mechanism costs in lines and time, and what switching it off costs.

A mechanism is a row of `mechanisms.py` beside this file: its modules, and the parameters and
functions that are replaced to switch it off. Every frame (`ablation_frames.py`) is segmented with
and without each of them, and the figures of the two are compared. Differences are averaged over
the frames of a sensor and then over the sensors; standard errors are those of the mean over
sensors, so that many frames of one sensor say no more of other sensors than a few do.

Frames are simulated, with a seed that nothing was made with, and those of real sensors in
`--data FOLDER`.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import pkgutil
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from ablation_frames import (
    DAMAGES,
    KINDS,
    Figures,
    real_frames,
    simulated,
    simulated_frames,
    terrain_run,
    track_run,
    tracked_room,
)
from mechanisms import MECHANISMS, Mechanism

from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation.terrain import terrain_tasks

ROOT = Path(__file__).parents[1]
CORE = ROOT / 'rangeseg_ros' / 'core'

# Columns of the tables, the unit that changes are told in, and whether more is better.
FRAMES = {
    **dict.fromkeys([*KINDS, 'other', 'simulated', *DAMAGES, 'all'], 1e-3),
    'curved': -1e-3,
    'border': 1e-3,
    'faces': 1e-3,
    'angle': -1e-3,
}
TERRAIN = {
    'ground kept': 1e-3,
    'ground called obstacle': -1e-3,
    'obstacle found': 1e-3,
    'obstacle called ground': -1e-3,
    'drop found': 1e-3,
    'drop called ground': -1e-3,
}
HAZARDS = ('obstacle called ground', 'drop called ground')
TRACKS = {'switches': -1.0, 'transfers': -1.0, 'coverage': 1e-3, 'track_length': 0.1}

Run = Callable[[Mapping[str, Any]], Figures]
Gains = dict[str, dict[str, dict[str, list[float]]]]


@contextlib.contextmanager
def switched(changes: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Parameters among the changes, while functions and constants of modules are replaced."""
    with contextlib.ExitStack() as stack:
        for name in (name for name in changes if '.' in name):
            target, new = f'rangeseg_ros.core.{name}', changes[name]
            original = pkgutil.resolve_name(target)
            stack.enter_context(mock.patch(target, new(original) if callable(new) else new))
        yield {name: value for name, value in changes.items() if '.' not in name}


def measure(runs: Iterator[tuple[str, Run]], chosen: Sequence[Mechanism]) -> Gains:
    """Gain of each mechanism, in each column, for each frame of each sensor: with minus without.

    And, under the name '', the figures with all of them.
    """
    table: Gains = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for sensor, run in runs:
        run({})  # kernels are loaded
        base = run({})
        for column, value in base.items():
            table[''][column][sensor].append(value)
        for mechanism in chosen:
            with switched(mechanism.changes) as parameters:
                other = run(parameters)
            sign = -1 if mechanism.option else 1
            for column in base.keys() & other.keys():
                gain = sign * (base[column] - other[column])
                table[mechanism.name][column][sensor].append(gain)
    return table


def pooled(of_sensors: Mapping[str, Sequence[float]]) -> tuple[float, float]:
    """Mean over sensors of the mean over their frames, and its standard error."""
    means = [np.nanmean(values) for values in of_sensors.values() if not np.isnan(values).all()]
    if len(means) < 2:
        return float(means[0]) if means else float('nan'), float('nan')
    return float(np.mean(means)), float(np.std(means, ddof=1) / len(means) ** 0.5)


def verdict(gains: Mapping[str, tuple[float, float]]) -> str:
    """Whether a mechanism earns its lines, from its gains and their errors in units of the table.

    It does by a gain above twice its standard error in any column, or above that over all sensors,
    and it harms by such a loss; half a unit at least. Empty where all may be chance.
    """
    found = []
    for word, sign in (('earns', 1), ('harms', -1)):
        columns = [
            column
            for column, (gain, error) in gains.items()
            if sign * gain > max((1 if column == 'all' else 2) * error, 0.5)
        ]
        found += [f'{word}: {", ".join(columns)}'] if columns else []
    return '; '.join(found)


def needed_for(row: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    """Kinds of scenes in which more than 1 % of a hazard is called ground without a mechanism."""
    kinds = {
        kind
        for column in HAZARDS
        for kind, gains in row.get(column, {}).items()
        if not np.isnan(gains).all() and -np.nanmean(gains) > 0.01
    }
    return f'safety: {", ".join(sorted(kinds))}' if kinds else ''


def source_of(modules: str) -> tuple[int, int]:
    """Lines and constants of modules, or of functions in them: `module.py:function,function`."""
    lines = constants = 0
    for entry in modules.split():
        name, _, functions = entry.partition(':')
        text = (CORE / name).read_text()
        tree = ast.parse(text)
        assigned = [s for s in tree.body if isinstance(s, ast.Assign)]
        names = [n for s in assigned for n in ast.walk(s.targets[0]) if isinstance(n, ast.Name)]
        known = {name.id for name in names if name.id.isupper()}
        if not functions:
            lines, constants = lines + len(text.splitlines()), constants + len(known)
        for node in ast.walk(tree):
            if getattr(node, 'name', None) in functions.split(',') and functions:
                first = min([node.lineno, *(item.lineno for item in node.decorator_list)])
                used = {item.id for item in ast.walk(node) if isinstance(item, ast.Name)}
                lines += node.end_lineno - first + 1
                constants += len(used & known)
    return lines, constants


def as_table(columns: Mapping[str, float], rows: Gains, chosen: Sequence[Mechanism]) -> str:
    """Markdown: the figures with all mechanisms, and how each changes when one is switched off."""
    shown = [column for column in columns if column in rows['']]
    heads = ['mechanism', 'lines', 'constants', 'ms', *shown, 'verdict']
    base = [f'{pooled(rows[""][column])[0]:.3f}' for column in shown]
    lines = [heads, ['---'] * len(heads), ['with all', '', '', _ms(rows['']), *base, '']]
    for mechanism in chosen:
        row = rows[mechanism.name]
        cells, gains = [], {}
        for column in shown:
            unit, (gain, error) = columns[column], pooled(row[column])
            gains[column] = gain / unit, error / abs(unit)
            cells.append('' if np.isnan(gain) else _change(-gain / abs(unit), error / abs(unit)))
        name = f'{mechanism.name} (an option)' if mechanism.option else mechanism.name
        size = map(str, source_of(mechanism.modules))
        words = [word for word in (needed_for(row), verdict(gains)) if word]
        lines.append([name, *size, _ms(row), *cells, '; '.join(words) or 'not shown'])
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def _ms(row: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    return f'{np.median(np.concatenate(list(row["ms"].values()))):.1f}'


def _change(change: float, error: float) -> str:
    digits = 0 if max(abs(change), error) >= 1 or change == 0 else 1
    return f'{round(change, digits) + 0.0:.{digits}f} ± {error:.{digits}f}'


PAGE = """\
# Ledger

What each mechanism (`.ci/mechanisms.py`) costs and buys: `make ablate` (`.ci/ablate.py`).
{frames}

- *lines*, *constants*: of its modules or functions; *ms*: processor time it takes. Other columns:
  the change when it is switched off, plus or minus the standard error over sensors, kinds of
  scenes or rooms; of an option, off by default, what is lacking without it.
- IoU in thousandths, of sensors by their kind, of simulated rooms, and of those without 30 % of
  the pixels (*holes*), with each fourth row and column four times (*enlarged*), not in *all*, in
  steps of 10 cm (*rounded*) or disparities. *curved*: share of what is not planar that is called a
  plane. Simulated, *border*: F measure of borders within 2 pixels; *faces*: IoU of faces in parts;
  *angle*: median error of normals, thousandths of a degree. Lengths of tracks: tenths of a frame.
- *verdict*: earns by a gain above two standard errors in a column, or one over all sensors; harms
  by such a loss; *safety*: the kinds of scenes in which more than 1 % of a hazard is called ground
  without it; *not shown*: all changes are within chance.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the mechanisms and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--data', type=Path, help='folder of sets of real frames')
    parser.add_argument('--frames', type=int, default=10, help='of a real sensor, at most')
    parser.add_argument('--scenes', type=int, default=3, help='scenes of each simulated sensor')
    parser.add_argument('--seed', type=int, default=41000, help='of the first scene')
    parser.add_argument('--only', default='', help='of the names of mechanisms: a pattern')
    parser.add_argument('--output', type=Path, help='page to write')
    given = parser.parse_args(arguments)
    seed, scenes = given.seed, given.scenes

    def of_frames() -> Iterator[tuple[str, Run]]:
        for frame in simulated_frames(seed, scenes):
            yield f'{frame.kind} {frame.sensor}', frame.run
        for frame in real_frames(given.data, given.frames) if given.data else ():
            yield frame.sensor, frame.run

    def of_terrains() -> Iterator[tuple[str, Run]]:
        for command in ('terrain', 'terrain --hard'):
            folder = simulated(command, seed, 13 * scenes)
            for known in (True, False):
                for task in terrain_tasks(folder, Config(), known, None):
                    kind = task.row['kind'] if known else f'{task.row["kind"]}, no height'
                    yield kind, lambda parameters, task=task: terrain_run(task, parameters)

    def of_walks() -> Iterator[tuple[str, Run]]:
        for room in range(seed, seed + 6 * scenes):
            frames = tracked_room(room)
            yield str(room), lambda parameters, frames=frames: track_run(frames, parameters)

    real = f' and up to {given.frames} frames of each real sensor' if given.data else ''
    told = f'Here with {scenes} scenes of each simulated sensor, from seed {seed} on{real}.'
    parts = [PAGE.format(frames=told)]
    for name, columns, runs in (
        ('frames', FRAMES, of_frames),
        ('terrain', TERRAIN, of_terrains),
        ('tracks', TRACKS, of_walks),
    ):
        members = [m for m in MECHANISMS if m.table == name and re.search(given.only, m.name)]
        if members:
            table = as_table(columns, measure(runs(), members), members)
            parts.append(f'## {name.capitalize()}\n\n{table}\n')
            print(parts[-1], flush=True)
    if given.output:
        given.output.write_text('\n'.join(parts))


if __name__ == '__main__':
    main()
