"""Ground is reached: a chain of seen ground, link by link, leads from the robot to it.

Cells that are neither steps nor too steep are looked at from near to far. What is reached already
predicts the next cell: the mean height of what was reached last in its own column and those beside
it, an exponential moving average along each. A chain so goes around what stands in its way, and a
cell that noise leads across an edge leads no others.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.significance import CLEARLY, OUTLIER

# Columns on either side whose ground leads to a cell.
_BESIDE = 4
# The widest gap in a chain, metres.
_GAP = 0.15
# Half the width of a small robot, metres: how far the ground that leads to a cell is looked for,
# and how much farther than the nearest ground in view a chain begins.
_RADIUS = 0.25
# Cells, as powers of two, over which a slope is measured.
_BASELINES = 6
# The last of these baselines, along columns and rows, that are beside a cell.
_NEXT = (2, 0)


def reach(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    highest: float,
    least: float,
    slope: float,
    turned: bool,
) -> NDArray[np.bool_]:
    """Cells (rows, columns) that a chain leads to.

    Parameters
    ----------
    place : (3, rows, columns) float64
        Height and horizontal position, metres; NaN where nothing is measured.
    variance : (rows, columns) float64
        Of the height of a cell, metres^2; 0 for cells that are no part of a chain.
    highest : float
        How far the ground under the robot may be off height 0, metres.
    least, slope : float
        The least step that is none of the ground, metres, and the tangent of the steepest one.
    turned : bool
        Whether the nearest row is the first.
    """
    even = np.zeros(variance.shape, np.bool_)
    run_rows(_find_even, len(even), place, variance, least, slope, even)
    reached = np.zeros(variance.shape, np.bool_)
    if turned:
        _spread(place, variance, even, highest, least, slope, reached)
    else:
        turn = place[:, ::-1], variance[::-1], even[::-1]
        _spread(*turn, highest, least, slope, reached[::-1])
    return reached


@njit(cache=True, nogil=True, error_model='numpy')
def _find_even(
    first: int,
    after: int,
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    least: float,
    slope: float,
    even: NDArray[np.bool_],
) -> None:
    """Whether cells are no steeper against others of their row and column than ground may be.

    Against those beside them, whatever they are, so that the foot of a wall is none; and on no
    slope that goes on to either side. Of rows first...after.
    """
    for i in range(first, after):
        for c in range(variance.shape[1]):
            even[i, c] = variance[i, c] > 0 and not _steep(place, variance, i, c, least, slope)


@njit(cache=True, nogil=True, error_model='numpy')
def _steep(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    i: int,
    c: int,
    least: float,
    slope: float,
) -> bool:
    rows, columns = variance.shape
    noise = np.sqrt(2 * variance[i, c])
    x, y, h = place[1, i, c], place[2, i, c], place[0, i, c]
    steepest = slope * slope
    for axis in range(2):
        for e in range(_BASELINES):
            near = e <= _NEXT[axis]
            off = OUTLIER * noise + least / 8
            last, total = 0.0, np.inf
            for sign in (-1, 1):
                p = i + (sign << e if axis == 0 else 0)
                q = c + (sign << e if axis == 1 else 0)
                if not (0 <= p < rows and 0 <= q < columns) or not variance[p, q] > 0:
                    continue
                up = sign * (place[0, p, q] - h)
                # What is level is not steep, however far away it is.
                if abs(up) < CLEARLY * noise:
                    continue
                way = (place[1, p, q] - x) ** 2 + (place[2, p, q] - y) ** 2
                # Beyond an edge the ground is hidden: what is next is farther than it is deep.
                if e == 0 or (near and way < least * least):
                    more = abs(up) - off
                    if more > 0 and more * more > steepest * way:
                        return True
                if 4 * way > least * least and up * up > steepest * way:
                    way = np.sqrt(way)
                    if up * last > 0 and abs(up + last) > slope * (way + total) + CLEARLY * noise:
                        return True
                    last, total = up, way
    return False


@njit(cache=True, nogil=True, error_model='numpy')
def _spread(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    even: NDArray[np.bool_],
    highest: float,
    least: float,
    slope: float,
    reached: NDArray[np.bool_],
) -> None:
    """Find what is reached, with the nearest row first."""
    rows, columns = variance.shape
    # Where the ground comes into view, no farther than the robot is wide from the nearest of it,
    # and what is nearest there to height 0.
    front, distance = np.full(columns, -1), np.full(columns, np.inf)
    for c in range(columns):
        for i in range(rows):
            if even[i, c] and abs(place[0, i, c]) < highest:
                front[c] = i
                distance[c] = np.sqrt(place[1, i, c] ** 2 + place[2, i, c] ** 2)
                break
    level, farthest = np.inf, distance.min() + _RADIUS
    for c in range(columns):
        if distance[c] > farthest:
            front[c] = -1
        elif abs(place[0, front[c], c]) < abs(level):
            level = place[0, front[c], c]
    # The steepest ground rises by a quarter of a step over the length of the mean: its lag behind
    # a slope that begins, the noise, and half a step are told apart.
    length = least / 4 / slope
    # Of each column: weight, mean, and where the cell is that was reached last.
    weight, mean = np.zeros(columns), np.zeros(columns)
    last = np.full((columns, 2), np.nan)
    for i in range(rows):
        for n in range(columns):
            c = n if i % 2 == 0 else columns - 1 - n
            if not even[i, c]:
                continue
            x, y, h = place[1, i, c], place[2, i, c], place[0, i, c]
            if not reached[i, c] and not (front[c] == i and abs(h - level) < least / 2):
                total = summed = 0.0
                nearest = np.inf
                for q in range(max(c - _BESIDE, 0), min(c + _BESIDE + 1, columns)):
                    way = np.sqrt((last[q, 0] - x) ** 2 + (last[q, 1] - y) ** 2)
                    if way <= _RADIUS:
                        nearest = min(nearest, way)
                        total += weight[q]
                        summed += weight[q] * mean[q]
                if nearest > _GAP or abs(h - summed / total) >= least / 2:
                    continue
            reached[i, c] = True
            kept = 0.0
            if weight[c] > 0:
                way = np.sqrt((last[c, 0] - x) ** 2 + (last[c, 1] - y) ** 2)
                kept = weight[c] * np.exp(-way / length)
            weight[c] = kept + 1 / variance[i, c]
            mean[c] += (h - mean[c]) / (variance[i, c] * weight[c])
            last[c, 0], last[c, 1] = x, y
