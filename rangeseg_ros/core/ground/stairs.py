"""Stairs up and down: level surfaces that follow each other at the same rise and run.

The rise is the period of the heights of level cells. Going outwards along a column of cells, the
noses of the treads, their edges that the robot sees, are where one tread ends and the next one is:
the number of a tread is a linear function of where its nose is, whose gradient is the direction of
the stairs and one over the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.ground.cells import axes_of
from rangeseg_ros.core.ground.classes import GROUND
from rangeseg_ros.core.ground.terrain import CellTerrain, Terrain
from rangeseg_ros.core.significance import SAMPLES

RISE, _RUN = (0.1, 0.24), (0.22, 0.4)
"""Rise and run of stairs, metres: the widest that codes of building allow.

The rise from the International Building Code (1011.5.2, four inches at least) to OSHA 1910.25(c)
(24 cm at most), the run from private stairs to those of general access in the British Approved
Document K, table 1.1.
"""
# Tangents of the flattest and the steepest stairs: what is flatter is level.
_FLATTEST, _STEEPEST = RISE[0] / _RUN[1], RISE[1] / _RUN[0]
# Treads and noses are within so much of a rise and a run of where they should be: nearer to that
# than to the middle between two.
_UNEVEN = 1 / 4
# The histogram of heights: width of a bin, and its end, metres.
_BIN, _HIGHEST = 0.005, 2.5


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

    edge: NDArray[np.float64]
    width: float
    count: int
    rise: float
    run: float
    direction: str

    def __str__(self) -> str:
        """Such as: up 4 x 0.17 / 0.28 m."""
        return f'{self.direction} {self.count} x {self.rise:.2f} / {self.run:.2f} m'


class _Noses(NamedTuple):
    """Noses of treads in the columns of cells.

    Attributes
    ----------
    number : (N,) int64
        Of the tread; 0 for the edge of the ground.
    place : (N, 2) float64
        On two horizontal axes, metres.
    """

    number: NDArray[np.int64]
    place: NDArray[np.float64]


def stairs_of(terrain: Terrain) -> list[Stairs]:
    """Staircases in sight: none or one up, none or one down.

    Parameters
    ----------
    terrain : Terrain
        The ground of the image.
    """
    cells = terrain.cells
    if cells is None:
        return []
    found = []
    for sign in (1, -1):
        # Nobody sees a tread from below.
        highest = terrain.stand.height(terrain.field.up) if sign > 0 else _HIGHEST
        level = _find_level(cells, sign, min(highest, _HIGHEST))
        sums = np.bincount((level[level > 0] / _BIN).astype(np.int64), minlength=1)
        rise, count = _find_rise(sums)
        if count > 1 and (stairs := _staircase(cells, level, sign, rise, count, terrain)):
            found.append(stairs)
    return found


@njit(cache=True, nogil=True)
def _find_level(cells: CellTerrain, sign: int, highest: float) -> NDArray[np.float32]:
    """Heights of level cells off the ground, times `sign`; 0 for all others.

    Only those that can be of stairs which begin where the ground ends in their column: not nearer
    than the steepest stairs are so high, not farther than the flattest.
    """
    height, place, kind, unsure = cells.height, cells.place, cells.kind, cells.unsure
    rows, columns = height.shape
    level = np.zeros((rows, columns), np.float32)
    for c in range(columns):
        x = y = np.float32(np.nan)
        for m in range(rows):
            i = m if cells.turned else rows - 1 - m
            h = sign * height[i, c]
            if kind[i, c] == GROUND and abs(h) < RISE[0] / 2:
                x, y = place[1, i, c], place[2, i, c]
            # Also false where nothing is measured.
            if not RISE[0] / 2 < h < highest or unsure[i, c] > _UNEVEN * RISE[1]:
                continue
            a, b = place[1, i, c] - x, place[2, i, c] - y
            way = np.sqrt(a * a + b * b)
            # Half as steep where the columns are at 60 degrees to the stairs. Also false where no
            # ground was.
            if not _FLATTEST / 2 * way - RISE[1] < h < _STEEPEST * way + RISE[1]:
                continue
            # A tread that is too thin to be measured is still seen between two risers.
            for step in (-1, 1):
                k = i + step
                while 0 < k < rows - 1 and np.isnan(height[k, c]):
                    k += step
                if 0 <= k < rows:
                    p, q = place[1, i, c] - place[1, k, c], place[2, i, c] - place[2, k, c]
                    if abs(height[i, c] - height[k, c]) < _FLATTEST * np.sqrt(p * p + q * q):
                        level[i, c] = h
    return level


@njit(cache=True, nogil=True)
def _find_rise(sums: NDArray[np.int64]) -> tuple[float, int]:
    """The period of a histogram of heights, and how many periods there are from its start.

    A tread has at least `SAMPLES` cells, twice as many in the half of a period around its height
    as in the other half, and is the better the nearer they are to it.
    """
    rise, count, most = 0.0, 0, 0.0
    for k in range(int((RISE[1] - RISE[0]) / _BIN * 2) + 1):
        period = RISE[0] / _BIN + k / 2  # in bins
        score, treads = 0.0, 0
        while (treads + 1.5) * period < len(sums) + period:
            middle = (treads + 1) * period
            on = off = 0
            apart = 0.0
            for b in range(int(middle - period / 2), min(int(middle + period / 2), len(sums))):
                far = abs(b + 0.5 - middle)
                if far <= _UNEVEN * period:
                    on += sums[b]
                    apart += far * sums[b]
                else:
                    off += sums[b]
            if on < SAMPLES or on < 2 * off:
                break
            treads += 1
            score += 1 - apart / on / (_UNEVEN * period)
        if score > most:
            rise, count, most = period * _BIN, treads, score
    return rise, count


@njit(cache=True, nogil=True)
def _find_noses(
    cells: CellTerrain, level: NDArray[np.float32], up: bool, rise: float, count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """Noses of treads, their places, and the number of each cell's tread; 0 elsewhere."""
    place, kind, height = cells.place, cells.kind, cells.height
    rows, columns = level.shape
    number, found = np.zeros((rows, columns), np.int64), 0
    numbers, places = np.empty(rows * columns, np.int64), np.empty((rows * columns, 2))
    for c in range(columns):
        # The cell measured before, and the farthest one of the tread or the ground that was last.
        before, last, tread = -1, -1, 0
        for m in range(rows):
            i = m if cells.turned else rows - 1 - m
            if np.isnan(place[0, i, c]):
                continue
            k = int(level[i, c] / rise + 0.5)
            if k > count or abs(level[i, c] - k * rise) > _UNEVEN * rise:
                k = 0
            number[i, c] = k
            # Near its edge, the ground is not told as such.
            if abs(height[i, c]) < _UNEVEN * rise and (kind[i, c] == GROUND or tread == 0):
                last, tread = i, 0
            elif k and last >= 0:
                if k == tread + 1 and up:
                    # The riser below is where the nose is, the tread begins behind it.
                    numbers[found] = k
                    places[found] = place[1:, before, c]
                    found += 1
                elif k == tread + 1:
                    numbers[found] = tread
                    # Half a cell goes on behind its middle.
                    inner = last + 1 if not cells.turned else last - 1
                    for n in range(2):
                        places[found, n] = place[1 + n, last, c]
                        if 0 <= inner < rows and not np.isnan(place[0, inner, c]):
                            step = place[1 + n, last, c] - place[1 + n, inner, c]
                            places[found, n] += step / 2
                    found += 1
                if k >= tread:
                    last, tread = i, k
            before = i
    return numbers[:found].copy(), places[:found].copy(), number


def _staircase(
    cells: CellTerrain,
    level: NDArray[np.float32],
    sign: int,
    rise: float,
    count: int,
    terrain: Terrain,
) -> Stairs | None:
    """The staircase with so many treads of that rise; None where the noses do not fit."""
    number, place, tread = _find_noses(cells, level, sign > 0, rise, count)
    seen = _Noses(number, place)
    first = int(sign > 0)
    # Treads that follow each other, each with a nose but the landing at the foot of stairs down.
    enough = np.bincount(number, minlength=count + 1) >= SAMPLES
    last = first
    while last <= count and enough[last]:
        last += 1
    seen = _Noses(number[number < last], place[number < last])
    if last - first < 2:
        return None
    fitted = _fit_noses(seen)
    if fitted is None:
        return None
    start, ahead, run, fits = fitted
    if not _RUN[0] <= run <= _RUN[1]:
        return None
    across = np.array([-ahead[1], ahead[0]])
    sides = []
    for k in range(first, last):
        here = fits & (seen.number == k)
        if here.sum() < SAMPLES:
            return None
        sides.append(np.quantile(seen.place[here] @ across, (0.02, 0.98)))
    # Boxes of several heights stand side by side, treads one behind the other.
    for (left, right), (low, high) in pairwise(sides):
        if min(right, high) - max(left, low) < min(right - left, high - low) / 2:
            return None
    ends = sides[0]
    if sign < 0:  # columns of cells that leave the stairs at their side see no nose there
        ends = np.quantile(across @ cells.place[1:, tread == 1], (0.02, 0.98))
    width = float(ends[1] - ends[0])
    if width < run:  # treads are wider than deep
        return None
    treads = last - first  # going down, there is one beyond each nose
    levels = np.array([np.median(level[tread == k]) for k in range(1, treads + 1)])
    steps = np.arange(1, treads + 1)
    edge = (start + first * run) * ahead + np.outer(ends, across)
    return Stairs(
        _on_ground(edge, terrain), width, treads, float(levels @ steps / (steps @ steps)), run,
        'up' if sign > 0 else 'down',
    )  # fmt: skip


def _fit_noses(
    noses: _Noses,
) -> tuple[float, NDArray[np.float64], float, NDArray[np.bool_]] | None:
    """Where tread 0 has its nose, direction, run, and which noses fit; None if most do not."""
    design = np.column_stack([np.ones(len(noses.place)), noses.place])
    fits = np.ones(len(design), np.bool_)
    for _ in range(4):
        solved = np.linalg.lstsq(design[fits], noses.number[fits].astype(float), rcond=None)[0]
        off = np.abs(design @ solved - noses.number)
        fits = off <= max(_UNEVEN, float(np.median(off)))
    fits = off <= _UNEVEN
    slope = float(np.linalg.norm(solved[1:]))
    if 2 * fits.sum() < len(fits) or slope == 0:
        return None
    ahead = solved[1:] / slope
    return -float(solved[0]) / slope, ahead, 1 / slope, fits


def _on_ground(ends: NDArray[np.float64], terrain: Terrain) -> NDArray[np.float64]:
    """Points (2, 3) of the ground under the robot at horizontal places."""
    axes = axes_of(terrain.field.up)
    theta = np.array(terrain.stand.theta)
    flat = ends @ axes[1:]
    depth = (1 - flat @ theta) / (axes[0] @ theta)
    result: NDArray[np.float64] = flat + depth[:, None] * axes[0]
    return result
