"""Stairs measured against the truth of simulated scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.ground.stairs import Stairs

# Pixels from which a tread counts as in sight, and metres that its pixels are off its height.
_FEWEST, _OFF = 300, 0.005
# Fewer treads in sight are a step or a drop.
_LEAST = 2


class StairsCheck(NamedTuple):
    """The treads of a scene's staircase in sight, and what was found of it.

    `found` are treads, and errors of rise and run, metres; `false` counts staircases that are not
    there.
    """

    in_sight: int
    found: tuple[int, float, float] | None
    false: int


def check_stairs(row: Mapping[str, str], height: Singles, found: Sequence[Stairs]) -> StairsCheck:
    """Compare stairs with those of a row of the table of scenes.

    The row has `direction`, `count`, `rise`, `run`, empty without stairs; `height` (H, W) is the
    true height above the ground, metres, NaN where nothing is measured.
    """
    true = row.get('direction', '')
    right = [stairs for stairs in found if stairs.direction == true]
    false = len(found) - len(right)
    if not true:
        return StairsCheck(0, None, false)
    rise, run = float(row['rise']), float(row['run'])
    levels = rise * np.arange(1, int(row['count']) + 1) * (1 if true == 'up' else -1)
    in_sight = sum(int((np.abs(height - level) < _OFF).sum() >= _FEWEST) for level in levels)
    errors = [(stairs.count, stairs.rise - rise, stairs.run - run) for stairs in right]
    return StairsCheck(in_sight, errors[0] if errors else None, false)


def stairs_figures(checks: Sequence[StairsCheck]) -> dict[str, Any]:
    """Figures over scenes; those with fewer than two treads in sight need not be found."""
    there = [check for check in checks if check.in_sight >= _LEAST]
    found = [(check.in_sight, *check.found) for check in there if check.found]
    in_sight, count, *errors = np.abs(np.array(found, np.float64).reshape(-1, 4)).T
    rise, run = (float(np.median(error)) if found else float('nan') for error in errors)
    return {
        'scenes_with_stairs': len(there),
        'found': len(found),
        'treads_in_sight': int(in_sight.sum()),
        'treads_found': int(count.sum()),
        'count_within_1': int((np.abs(in_sight - count) <= 1).sum()),
        'median_rise_error': rise,
        'median_run_error': run,
        'largest_rise_error': float(errors[0].max(initial=0)),
        'largest_run_error': float(errors[1].max(initial=0)),
        'false_alarms': sum(check.false for check in checks),
        'scenes_without_stairs': sum(not check.in_sight for check in checks),
    }


def stairs_line(figures: Mapping[str, Any]) -> str:
    """Text of `stairs_figures`."""
    f = figures
    rise, run = 1000 * f['median_rise_error'], 1000 * f['median_run_error']
    errors = f'; median error of rise {rise:.0f} mm, of run {run:.0f} mm' if f['found'] else ''
    return (
        f'stairs: {f["found"]} of {f["scenes_with_stairs"]} found, {f["treads_found"]} of their '
        f'{f["treads_in_sight"]} treads in sight{errors}; {f["false_alarms"]} false alarms, '
        f'{f["scenes_without_stairs"]} scenes without stairs'
    )
