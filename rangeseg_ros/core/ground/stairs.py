"""Stairs up and down: level surfaces that follow each other at the same rise and run.

The rise is the period of the heights of level cells. Going outwards along a column of cells, the
noses of the treads, their edges that the robot sees, are where one tread ends and the next one is:
the number of a tread is a linear function of where its nose is, whose gradient is the direction of
the stairs and one over the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Singles
from rangeseg_ros.core.ground.cells import GROUND, axes_of
from rangeseg_ros.core.ground.terrain import CellTerrain, Terrain
from rangeseg_ros.core.significance import OUTLIER, SAMPLES

RISE, _RUN = (0.1, 0.24), (0.22, 0.4)
"""Rise and run of stairs, metres: the widest that codes of building allow.

The rise from the International Building Code (1011.5.2, four inches at least) to OSHA 1910.25(c)
(24 cm at most), the run from private stairs to those of general access in the British Approved
Document K, table 1.1.
"""
# Treads and noses are within so much of a rise and a run of where they should be: nearer to that
# than to the middle between two.
_UNEVEN = 1 / 4
# Width of the bins of the histogram of heights, metres.
_BIN = 0.005


@dataclass(frozen=True, eq=False)
class Stairs:
    """A staircase.

    Attributes
    ----------
    edge : (2, 3) float64
        Ends of the first edge, as wide as the stairs are in sight, on the ground: the foot of the
        first riser, or the edge that the stairs go down from. Metres, in the frame of the image.
    width : float
        Length of the edge, metres.
    count : int
        Treads in sight.
    rise, run : float
        Of a tread, metres.
    direction : {'up', 'down'}
    """

    edge: Floats
    width: float
    count: int
    rise: float
    run: float
    direction: str

    def __str__(self) -> str:
        """Such as: up 4 x 0.17 / 0.28 m."""
        return f'{self.direction} {self.count} x {self.rise:.2f} / {self.run:.2f} m'


def stairs_of(terrain: Terrain) -> list[Stairs]:
    """Staircases in sight: none or one up, none or one down."""
    cells = terrain.cells
    if cells is None:
        return []
    found = []
    for sign in (1, -1):
        # Nobody sees a tread from below.
        highest = terrain.stand.height(terrain.field.up) if sign > 0 else np.inf
        level = _find_level(cells, sign, highest)
        sums = np.bincount((level[level > 0] / _BIN).astype(np.int64), minlength=1)
        rise, count = _find_rise(sums)
        if count > 1 and (stairs := _staircase(cells, level, sign, rise, count, terrain)):
            found.append(stairs)
    return found


def _find_level(cells: CellTerrain, sign: int, highest: float) -> Singles:
    """Heights of level cells off the ground, times `sign`; 0 for all others."""
    rows = np.arange(len(cells.height))[:, None]
    columns = np.arange(cells.height.shape[1])[None]
    measured = np.isfinite(cells.height)
    before = np.maximum.accumulate(np.where(measured, rows, 0), axis=0)[:-1]
    # A tread that is too thin to be measured is still seen between two risers.
    apart = cells.place[:, 1:] - cells.place[:, before, columns]
    flattest = RISE[0] / _RUN[1]  # stairs; what is flatter is level
    flat = np.abs(apart[0]) < flattest * np.hypot(apart[1], apart[2])
    level = np.zeros(measured.shape, np.bool_)
    level[1:] = flat
    level[before[flat], np.nonzero(flat)[1]] = True
    height = sign * cells.height
    level &= (height > RISE[0] / 2) & (height < highest)
    return np.where(level & (OUTLIER * cells.error <= _UNEVEN * RISE[1]), height, np.float32(0))


def _find_rise(sums: NDArray[np.int64]) -> tuple[float, int]:
    """The period of a histogram of heights, and how many periods there are from its start.

    A tread has at least `SAMPLES` cells, twice as many in the half of a period around its height
    as in the other half, and is the better the nearer they are to it.
    """
    rises = np.arange(RISE[0], RISE[1], _BIN / 2)
    heights = (np.arange(len(sums)) + 0.5) * _BIN / rises[:, None]  # in periods
    tread = np.rint(heights).astype(np.int64)
    off = np.abs(heights - tread)
    on = off <= _UNEVEN
    most = int(tread.max()) + 2
    cell = tread + most * np.arange(len(rises))[:, None]
    inside, outside, apart = (
        np.bincount(cell.ravel(), (sums * share).ravel(), most * len(rises)).reshape(-1, most)
        for share in (on, ~on, on * off)
    )
    enough = (inside >= SAMPLES) & (inside >= 2 * outside)
    enough = np.logical_and.accumulate(enough[:, 1:], axis=1)
    quality = enough * (1 - apart / np.maximum(inside, 1) / _UNEVEN)[:, 1:]
    best = quality.sum(axis=1).argmax()
    return float(rises[best]), int(enough[best].sum())


def _find_noses(
    place: Singles, tread: NDArray[np.int64], up: bool, count: int
) -> tuple[NDArray[np.int64], Floats]:
    """Numbers (N,) of treads and places (N, 2) of their noses, in each column from near to far.

    Where a tread comes into view behind its riser, and where one ends going down.
    """
    rows = np.arange(len(tread))[:, None]
    numbers, places = [], []
    for k in range(1, count + 1):
        begin = np.where((tread == k).any(axis=0), (tread == k).argmax(axis=0), 0)
        before = (tread == k - 1) & (rows < begin)
        last = len(tread) - 1 - before[::-1].argmax(axis=0)
        columns = np.flatnonzero(before.any(axis=0))
        nose = (begin - 1 if up else last)[columns]
        there = np.isfinite(place[0, nose, columns])
        places.append(place[1:, nose[there], columns[there]].T)
        numbers.append(np.full(np.count_nonzero(there), k if up else k - 1))
    return np.concatenate(numbers), np.concatenate(places).astype(np.float64)


def _staircase(
    cells: CellTerrain, level: Singles, sign: int, rise: float, count: int, terrain: Terrain
) -> Stairs | None:
    """The staircase with so many treads of that rise; None where the noses do not fit."""
    tread = np.rint(level / rise).astype(np.int64)
    tread[(tread < 1) | (tread > count) | (np.abs(level - rise * tread) > _UNEVEN * rise)] = -1
    tread[(cells.kind == GROUND) & (np.abs(cells.height) < _UNEVEN * rise)] = 0
    number, place = _find_noses(cells.place, tread, sign > 0, count)
    first = int(sign > 0)
    # Treads that follow each other, each with a nose but the landing at the foot of stairs down.
    enough = np.bincount(number, minlength=count + 2) >= SAMPLES
    last = first + int(enough[first:].argmin())
    number, place = number[number < last], place[number < last]
    fitted = _fit_noses(number, place) if last - first > 1 else None
    if fitted is None:
        return None
    start, ahead, run = fitted
    across = np.array([-ahead[1], ahead[0]])
    sides = [np.quantile(place[number == k] @ across, (0.02, 0.98)) for k in range(first, last)]
    # Boxes of several heights stand side by side, treads one behind the other.
    for (left, right), (low, high) in pairwise(sides):
        if min(right, high) - max(left, low) < min(right - left, high - low) / 2:
            return None
    ends = sides[0]
    if sign < 0:  # columns of cells that leave the stairs at their side see no nose there
        ends = np.quantile(across @ cells.place[1:, tread == 1], (0.02, 0.98))
    treads = last - first  # going down, there is one beyond each nose
    levels = np.array([np.median(level[tread == k]) for k in range(1, treads + 1)])
    steps = np.arange(1, treads + 1)
    edge = (start + first * run) * ahead + np.outer(ends, across)
    return Stairs(
        _on_ground(edge, terrain), float(np.ptp(ends)), treads,
        float(levels @ steps / (steps @ steps)), run, 'up' if sign > 0 else 'down',
    )  # fmt: skip


def _fit_noses(number: NDArray[np.int64], place: Floats) -> tuple[float, Floats, float] | None:
    """Where tread 0 has its nose, direction and run; None where half of the noses do not fit."""
    design = np.column_stack([np.ones(len(place)), place])
    fits = np.ones(len(design), np.bool_)
    for _ in range(4):
        solved = np.linalg.lstsq(design[fits], number[fits].astype(float), rcond=None)[0]
        off = np.abs(design @ solved - number)
        fits = off <= max(_UNEVEN, float(np.median(off)))
    slope = float(np.linalg.norm(solved[1:]))
    if np.median(off) > _UNEVEN or not 1 / _RUN[1] <= slope <= 1 / _RUN[0]:
        return None
    return -float(solved[0]) / slope, solved[1:] / slope, 1 / slope


def _on_ground(ends: Floats, terrain: Terrain) -> Floats:
    """Points (2, 3) of the ground under the robot at horizontal places."""
    axes = axes_of(terrain.field.up)
    theta = np.array(terrain.stand.theta)
    flat = ends @ axes[1:]
    depth = (1 - flat @ theta) / (axes[0] @ theta)
    result: Floats = flat + depth[:, None] * axes[0]
    return result
