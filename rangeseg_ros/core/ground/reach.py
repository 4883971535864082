"""Ground is reached: a chain of seen ground, link by link, leads from the robot to it.

Cells are looked at from near to far, and once more from far to near. What is reached already
predicts the next cell by local linear regression: its height by the mean of what was reached last,
its slope by a plane through more of it, with weights that decrease with the distance, of the
cell's own column and those beside it, so that a chain goes around what stands in its way. A cell
is reached where it is neither a step from what is predicted nor, with the cells around it, too
steep.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.ground.estimate import add_point, solve
from rangeseg_ros.core.significance import CLEARLY, OUTLIER

# Share of the least step that the steepest ground rises by over the length of the mean: its lag
# behind a slope that begins, the noise, and half a step are told apart.
_QUARTER = 1 / 4
# The plane is of a length four times as large: its weights are fourth roots of the mean's.
_LONGER = 4
# Of the least step: what the continued plane may be off by where a slope begins, and what a mixed
# pixel of a step shows at least.
_BENT, _JUMP = 0.8, 1 / 8
# Columns on either side whose ground leads to a cell, and lengths of the mean over which it does.
_BESIDE, _GAP = 2, 2.0
# Cells, as powers of two, over which a slope is measured, and the longest such way, metres.
_BASELINES, _WAY = 5, 0.4


@njit(cache=True, nogil=True, error_model='numpy')
def reach(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    nearest: NDArray[np.int64],
    plane: tuple[float, float, float],
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
        Of the height of a cell, metres^2.
    nearest : (columns,) int64
        Row of the nearest cell of each column; -1 for none.
    plane : (a, b, c)
        Height a + b x + c y of the ground under the robot.
    least, slope : float
        The least step that is none of the ground, metres, and the tangent of the steepest one.
    turned : bool
        Whether the nearest row is the first.
    """
    rows, columns = variance.shape
    reached = np.zeros((rows, columns), np.bool_)
    # Sums of a column: those of `solve` for the plane, those of 1, x, y, h for the mean, and where
    # the cell is that was reached last.
    sums, means = np.zeros((columns, 9)), np.zeros((columns, 4))
    last = np.full((columns, 2), np.nan)
    total, mean = np.empty(9), np.empty(4)
    start = _first(place, nearest, plane, least)
    length = least * _QUARTER / slope
    for outward in (True, False):
        for m in range(rows):
            i = m if outward == turned else rows - 1 - m
            for n in range(columns):
                c = n if m % 2 == 0 else columns - 1 - n
                if reached[i, c] or not variance[i, c] > 0:
                    continue
                x, y, h = place[1, i, c], place[2, i, c], place[0, i, c]
                noise = np.sqrt(variance[i, c])
                span = length * max(1.0, 1.5 * noise / (least * _QUARTER))
                if i == nearest[c] and outward and np.sqrt(x * x + y * y) < start:
                    found = abs(h - plane[0] - plane[1] * x - plane[2] * y) < least / 2
                else:
                    found = _linked(
                        x, y, h, c, variance[i, c], span, length, sums, means, last, total,
                        mean, plane, least, slope,
                    )  # fmt: skip
                if found and _even(place, variance, i, c, least, slope):
                    reached[i, c] = True
                    _add(x, y, h, 1 / variance[i, c], span, sums[c], means[c], last[c])
    return reached


@njit(cache=True, inline='always')
def _first(
    place: NDArray[np.float64],
    nearest: NDArray[np.int64],
    plane: tuple[float, float, float],
    least: float,
) -> float:
    """Distance up to which nearest cells may be where the chain begins, metres."""
    distance = np.inf
    for c in range(len(nearest)):
        i = nearest[c]
        if i >= 0:
            x, y = place[1, i, c], place[2, i, c]
            if abs(place[0, i, c] - plane[0] - plane[1] * x - plane[2] * y) < least / 2:
                distance = min(distance, np.sqrt(x * x + y * y))
    return distance + 5 * least


@njit(cache=True, inline='always')
def _decay(way: float) -> float:
    """exp(-way) by the first terms of exp(way), which is all that weights need."""
    return 1 / (1 + way * (1 + way * (0.5 + way / 6)))


@njit(cache=True, nogil=True, error_model='numpy')
def _linked(
    x: float,
    y: float,
    h: float,
    c: int,
    variance: float,
    span: float,
    length: float,
    sums: NDArray[np.float64],
    means: NDArray[np.float64],
    last: NDArray[np.float64],
    total: NDArray[np.float64],
    mean: NDArray[np.float64],
    plane: tuple[float, float, float],
    least: float,
    slope: float,
) -> bool:
    """Whether a cell continues what was reached around it."""
    total[:], mean[:] = 0, 0
    near = np.inf
    for q in range(max(c - _BESIDE, 0), min(c + _BESIDE + 1, len(last))):
        way = np.sqrt((last[q, 0] - x) ** 2 + (last[q, 1] - y) ** 2)
        if not way < 4 * _LONGER * span:
            continue
        near = min(near, way)
        weight = _decay(way / (_LONGER * span))
        for n in range(9):
            total[n] += weight * sums[q, n]
        weight *= weight
        weight *= weight
        for n in range(4):
            mean[n] += weight * means[q, n]
    if not near <= max(_GAP * length, span) or not mean[0] * variance > 0:
        return False
    a, b, d = solve(total, 1e-6, (2 / slope) ** 2, (0.0, plane[1], plane[2]))[:3]
    u, v, w = mean[1] / mean[0], mean[2] / mean[0], mean[3] / mean[0]
    noise = CLEARLY * np.sqrt(variance + 1 / mean[0])
    if abs(h - w - b * (x - u) - d * (y - v)) >= min(least / 2, least * _QUARTER + noise):
        return False
    if abs(h - a - b * x - d * y) >= _BENT * least or b * b + d * d >= slope * slope:
        return False
    return abs(h - w) < slope * np.sqrt((x - u) ** 2 + (y - v) ** 2) + noise


@njit(cache=True, nogil=True, error_model='numpy')
def _even(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    i: int,
    c: int,
    least: float,
    slope: float,
) -> bool:
    """Whether a cell lies in no step and on no slope that is too steep, along and across."""
    rows, columns = variance.shape
    noise = np.sqrt(2 * variance[i, c])
    for axis in range(2):
        for e in range(_BASELINES):
            k, m = (1 << e, 0) if axis == 0 else (0, 1 << e)
            rise, fall, ahead, back = 0.0, 0.0, 0.0, 0.0
            for sign in (-1, 1):
                p, q = i + sign * k, c + sign * m
                if not (0 <= p < rows and 0 <= q < columns) or not variance[p, q] > 0:
                    continue
                x, y = place[1, p, q] - place[1, i, c], place[2, p, q] - place[2, i, c]
                way = np.sqrt(x * x + y * y)
                difference = sign * (place[0, p, q] - place[0, i, c])
                neighbours = e == 0 or (e == 1 and axis == 0)
                bound = slope * way + OUTLIER * noise + _JUMP * least
                if neighbours and abs(difference) > bound:
                    return False
                if sign < 0:
                    rise, ahead = difference, way
                else:
                    fall, back = difference, way
            if min(ahead, back) < least / 2 or max(ahead, back) > _WAY:
                continue
            up = 1.0 if rise + fall > 0 else -1.0
            both = min(up * rise / ahead, up * fall / back)
            if both > slope and abs(rise + fall) > slope * (ahead + back) + CLEARLY * noise:
                return False
    return True


@njit(cache=True, inline='always')
def _add(
    x: float,
    y: float,
    h: float,
    weight: float,
    span: float,
    sums: NDArray[np.float64],
    means: NDArray[np.float64],
    last: NDArray[np.float64],
) -> None:
    """Add a cell to the sums of its column, in which what is farther away counts less."""
    long, short = 0.0, 0.0
    if last[0] == last[0]:
        long = _decay(np.sqrt((last[0] - x) ** 2 + (last[1] - y) ** 2) / (_LONGER * span))
        short = long**_LONGER
    sums *= long
    add_point(sums, x, y, h, weight)
    means *= short
    for n, entry in enumerate((1.0, x, y, h)):
        means[n] += weight * entry
    last[0], last[1] = x, y
