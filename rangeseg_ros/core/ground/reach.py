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
# Columns on either side of which most must agree with a link, and how far away, metres.
_VOTERS = 4
# Radius of where a chain begins, in least steps: half of a small robot.
_START = 5
# Cells, as powers of two, over which a slope is measured, and the longest such way, metres.
_BASELINES, _WAY = 6, 0.8
# The last of these baselines, along columns and rows, that are beside a cell.
_NEXT = (2, 0)


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
    x_first, y_first = _first(place, nearest, plane, least)
    length = least * _QUARTER / slope
    for outward in (True, False):
        for m in range(rows):
            i = m if outward == turned else rows - 1 - m
            before = i - 1 if outward == turned else i + 1
            for n in range(columns):
                c = n if m % 2 == 0 else columns - 1 - n
                if not variance[i, c] > 0:
                    continue
                x, y, h = place[1, i, c], place[2, i, c], place[0, i, c]
                noise = np.sqrt(variance[i, c])
                span = length * max(1.0, 1.5 * noise / (least * _QUARTER))
                if reached[i, c]:
                    _add(x, y, h, 1 / variance[i, c], span, sums[c], means[c], last[c])
                    continue
                # What comes back has passed where noise is as high as steps: it must be sure.
                if not outward and OUTLIER * noise > least / 2:
                    continue
                off = np.sqrt((x - x_first) ** 2 + (y - y_first) ** 2)
                if i == nearest[c] and outward and off < _START * least:
                    found = _agrees(place, i, c, plane, least)
                else:
                    gap = max(_GAP * length, span)
                    found = _linked(
                        x, y, h, c, variance[i, c], span, gap, sums, means, last, total,
                        mean, plane, least, slope,
                    )  # fmt: skip
                if found and _even(place, variance, reached, i, before, c, least, slope):
                    reached[i, c] = True
                    _add(x, y, h, 1 / variance[i, c], span, sums[c], means[c], last[c])
    return reached


@njit(cache=True, inline='always')
def _agrees(
    place: NDArray[np.float64], i: int, c: int, plane: tuple[float, float, float], least: float
) -> bool:
    """Whether a cell is of the ground under the robot."""
    off = place[0, i, c] - plane[0] - plane[1] * place[1, i, c] - plane[2] * place[2, i, c]
    return bool(abs(off) < least / 2)


@njit(cache=True, inline='always')
def _first(
    place: NDArray[np.float64],
    nearest: NDArray[np.int64],
    plane: tuple[float, float, float],
    least: float,
) -> tuple[float, float]:
    """Where the chain begins: the place (x, y) of the nearest cell of the ground."""
    distance, x, y = np.inf, np.inf, np.inf
    for c in range(len(nearest)):
        i = nearest[c]
        if i >= 0 and _agrees(place, i, c, plane, least):
            square = place[1, i, c] ** 2 + place[2, i, c] ** 2
            if square < distance:
                distance, x, y = square, place[1, i, c], place[2, i, c]
    return x, y


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
    gap: float,
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
    if not near <= gap or not mean[0] * variance > 0:
        return False
    a, b, d = solve(total, 1e-6, (2 / slope) ** 2, (0.0, plane[1], plane[2]))[:3]
    u, v, w = mean[1] / mean[0], mean[2] / mean[0], mean[3] / mean[0]
    noise = CLEARLY * np.sqrt(variance + 1 / mean[0])
    if abs(h - w - b * (x - u) - d * (y - v)) >= min(least / 2, least * _QUARTER + noise):
        return False
    if abs(h - a - b * x - d * y) >= _BENT * least or b * b + d * d >= slope * slope:
        return False
    if abs(h - w) >= slope * np.sqrt((x - u) ** 2 + (y - v) ** 2) + noise:
        return False
    # Most of the columns agree: one that noise leads across an edge leads no others.
    votes = 0
    for q in range(max(c - _VOTERS, 0), min(c + _VOTERS + 1, len(last))):
        if means[q, 0] > 0:
            u, v = means[q, 1] / means[q, 0], means[q, 2] / means[q, 0]
            w = means[q, 3] / means[q, 0]
            if (x - u) ** 2 + (y - v) ** 2 < _WAY * _WAY:
                votes += 1 if abs(h - w - b * (x - u) - d * (y - v)) < least / 2 else -1
    return votes > 0


@njit(cache=True, nogil=True, error_model='numpy')
def _even(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    reached: NDArray[np.bool_],
    i: int,
    before: int,
    c: int,
    least: float,
    slope: float,
) -> bool:
    """Whether a cell is no steeper against the cells of its row and its column than ground may be.

    Against those beside it, whatever they are, so that the foot of a wall is none; against those
    farther away where they are ground, in the row `before` as well; and on no slope that goes on
    to either side.
    """
    rows, columns = variance.shape
    noise = np.sqrt(2 * variance[i, c])
    x, y, h = place[1, i, c], place[2, i, c], place[0, i, c]
    steepest = slope * slope
    for axis in range(2):
        for e in range(_BASELINES):
            near = e <= _NEXT[axis]
            off = OUTLIER * noise + _JUMP * least if near else CLEARLY * noise
            last, total = 0.0, np.inf
            for sign in (-1, 1):
                p = i + (sign << e if axis == 0 else 0)
                q = c + (sign << e if axis == 1 else 0)
                if not (0 <= p < rows and 0 <= q < columns):
                    continue
                if axis == 1 and not reached[p, q] and 0 <= before < rows and reached[before, q]:
                    p = before
                if not variance[p, q] > 0:
                    continue
                up = sign * (place[0, p, q] - h)
                # What is level is not steep, however far away it is.
                if abs(up) < CLEARLY * noise:
                    continue
                way = (place[1, p, q] - x) ** 2 + (place[2, p, q] - y) ** 2
                if way > _WAY * _WAY:
                    continue
                # Beyond an edge the ground is hidden: what is next is farther than it is deep.
                if e == 0 or (near and way < least * least) or reached[p, q]:
                    more = abs(up) - off
                    if more > 0 and more * more > steepest * way:
                        return False
                if 4 * way > least * least and up * up > steepest * way:
                    way = np.sqrt(way)
                    if up * last > 0 and abs(up + last) > slope * (way + total) + CLEARLY * noise:
                        return False
                    last, total = up, way
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
