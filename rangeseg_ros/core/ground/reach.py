"""Ground is reached: a chain of seen ground, link by link, leads from the robot to it.

Cells beside no step and on no slope are looked at from near to far. What is reached already
predicts the next cell: the mean height of what was reached last in its own column and those beside
it, an exponential moving average along each. A chain so goes around what stands in its way. What
is off the ground in its column goes on to be, until it has come back to it: noise that hides an
edge farther away leads no chain across.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.ground.cells import WINDOW
from rangeseg_ros.core.significance import CLEARLY, OUTLIER

# Columns on either side whose ground leads to a cell.
_BESIDE = 4
# Cells, as powers of two, over which a slope is measured along rows and columns.
_BASELINES = 6


class Passable(NamedTuple):
    """What a robot drives over.

    Attributes
    ----------
    step : float
        The least step that it does not take, metres.
    slope : float
        Tangent of the steepest ground.
    gap : float
        The widest gap in the ground that it crosses, metres.
    radius : float
        Of the robot, metres: how far ground is looked for that leads to a cell, and how much
        farther than the nearest ground in view a chain begins.
    """

    step: float
    slope: float
    gap: float
    radius: float


def reach(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    shared: NDArray[np.float64],
    highest: float,
    passable: Passable,
    turned: bool,
) -> NDArray[np.bool_]:
    """Cells (rows, columns) that a chain leads to.

    Parameters
    ----------
    place : (3, rows, columns) float64
        Height and horizontal position, metres; NaN where nothing is measured.
    variance : (rows, columns) float64
        Of the height of a cell, metres^2; 0 for cells that are no part of a chain.
    shared : (rows, columns) float64
        See `Cells`.
    highest : float
        How far the ground under the robot may be off height 0, metres.
    passable : Passable
    turned : bool
        Whether the nearest row is the first.
    """
    even = _without_steps(place, variance, passable)
    even[_find_slopes(place, variance, shared, passable)] = False
    reached = np.zeros(variance.shape, np.bool_)
    if turned:
        _spread(place, variance, even, highest, passable, reached)
    else:
        turn = place[:, ::-1], variance[::-1], even[::-1]
        _spread(*turn, highest, passable, reached[::-1])
    return reached


@njit(cache=True, nogil=True, error_model='numpy')
def _without_steps(
    place: NDArray[np.float64], variance: NDArray[np.float64], passable: Passable
) -> NDArray[np.bool_]:
    """Measured cells (rows, columns) that are beside no step and on no slope along an axis.

    A step is between cells side by side, whatever they are, so that the foot of a wall is none of
    the ground. A slope rises or falls twice in three cells; where they lie on a line, all three
    are on it, else the middle one.
    """
    step, slope = passable.step, passable.slope
    _, rows, columns = place.shape
    even = variance > 0
    for axis in range(2):
        for e in range(_BASELINES):
            down, right = (1 << e, 0) if axis == 0 else (0, 1 << e)
            for i in range(rows - down):
                for c in range(columns - right):
                    k, m = i + down, c + right
                    if not variance[i, c] * variance[k, m] > 0:
                        continue
                    up = place[0, k, m] - place[0, i, c]
                    noise = np.sqrt(variance[i, c] + variance[k, m])
                    if abs(up) < CLEARLY * noise:  # level, however far away
                        continue
                    x, y = place[1, k, m] - place[1, i, c], place[2, k, m] - place[2, i, c]
                    way = np.sqrt(x * x + y * y)
                    # Beyond an edge the ground is hidden: what is next is farther than it is deep.
                    beside = e == 0 or way < step
                    if beside and abs(up) > slope * way + OUTLIER * noise + step / 8:
                        even[i, c] = even[k, m] = False
                    p, q = k + down, m + right
                    if 2 * way < step or abs(up) <= slope * way or p >= rows or q >= columns:
                        continue
                    if not variance[p, q] > 0:
                        continue
                    total = place[0, p, q] - place[0, i, c]
                    x, y = place[1, p, q] - place[1, k, m], place[2, p, q] - place[2, k, m]
                    on = np.sqrt(x * x + y * y)
                    if up * (total - up) <= 0 or abs(total - up) <= slope * on:
                        continue
                    noise = np.sqrt(variance[i, c] + variance[p, q])
                    if abs(total) > slope * (way + on) + CLEARLY * noise:
                        even[k, m] = False
                        if abs(up - total * way / (way + on)) < CLEARLY * noise:
                            even[i, c] = even[p, q] = False
    return even


def _find_slopes(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    shared: NDArray[np.float64],
    passable: Passable,
) -> NDArray[np.bool_]:
    """Cells (rows, columns) of windows that a plane fits and that are steep in any direction."""
    known = variance > 0
    h, x, y = np.where(known, place, 0)
    weight = known / (variance + (passable.step / 16) ** 2)
    wx, wy, wh = weight * x, weight * y, weight * h
    terms = (known, weight, wx, wy, wh, wx * x, wx * y, wy * y, wx * h, wy * h, wh * h, shared)
    size = WINDOW, WINDOW
    sums = cv2.boxFilter(
        np.stack(terms, axis=-1), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    steep = _find_steep(np.asarray(sums, np.float64), passable.slope)
    found: NDArray[np.bool_] = cv2.dilate(steep, np.ones(size, np.uint8)) > 0
    return found


@njit(cache=True, nogil=True, error_model='numpy')
def _find_steep(sums: NDArray[np.float64], slope: float) -> NDArray[np.uint8]:
    """Whether weighted least squares of sums (rows, columns, 12) fit planes that are steep."""
    steep = np.zeros(sums.shape[:2], np.uint8)
    for i in range(len(sums)):
        for c in range(sums.shape[1]):
            n, w, x, y, h, xx, xy, yy, xh, yh, hh, shared = sums[i, c]
            if 2 * n < WINDOW * WINDOW:
                continue
            xx, xy, yy = xx - x * x / w, xy - x * y / w, yy - y * y / w
            xh, yh, hh = xh - x * h / w, yh - y * h / w, hh - h * h / w
            determinant = xx * yy - xy * xy
            a, b = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
            square = a * a + b * b
            if not (square > slope * slope and hh - a * xh - b * yh < n - 3):
                continue
            # Of the gradient along itself.
            error = (yy * a * a - 2 * xy * a * b + xx * b * b) / square / determinant
            steep[i, c] = np.sqrt(square) > slope + CLEARLY * np.sqrt(error * shared / n)
    return steep


@njit(cache=True, nogil=True, error_model='numpy')
def _spread(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    even: NDArray[np.bool_],
    highest: float,
    passable: Passable,
    reached: NDArray[np.bool_],
) -> None:
    """Find what is reached, with the nearest row first."""
    half, radius = passable.step / 2, passable.radius
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
    level, farthest = np.inf, distance.min() + radius
    for c in range(columns):
        if distance[c] > farthest:
            front[c] = -1
        elif abs(place[0, front[c], c]) < abs(level):
            level = place[0, front[c], c]
    # The steepest ground rises by a quarter of a step over the length of the mean: its lag behind
    # a slope that begins, the noise, and half a step are told apart.
    length = half / 2 / passable.slope
    # Of each column: weight, mean, and where the cell is that was reached last; how far what is
    # seen is off the ground that leads to it, and where that was seen last.
    weight, mean, off = np.zeros(columns), np.zeros(columns), np.zeros(columns)
    last, seen = np.full((columns, 3), np.nan), np.full((columns, 4), np.nan)
    for i in range(rows):
        for n in range(columns):
            c = n if i % 2 == 0 else columns - 1 - n
            if not variance[i, c] > 0:
                continue
            h, x, y = place[0, i, c], place[1, i, c], place[2, i, c]
            if reached[i, c] or (front[c] == i and abs(h - level) < half):
                apart, nearest = 0.0, 0.0
            else:
                total = summed = 0.0
                nearest = np.inf
                for q in range(max(c - _BESIDE, 0), min(c + _BESIDE + 1, columns)):
                    way = np.sqrt((last[q, 1] - x) ** 2 + (last[q, 2] - y) ** 2)
                    if way <= radius:
                        nearest = min(nearest, way)
                        total += weight[q]
                        summed += weight[q] * mean[q]
                if total == 0:
                    continue
                apart = h - summed / total
            near = abs(apart) < half and nearest <= passable.gap
            way = np.sqrt((seen[c, 1] - x) ** 2 + (seen[c, 2] - y) ** 2)
            # Over a wall, or beyond an edge, it is another surface.
            noise = np.sqrt(variance[i, c] + seen[c, 3])
            if abs(h - seen[c, 0]) < passable.slope * way + CLEARLY * noise and way < radius:
                apart += (off[c] - apart) * np.exp(-way / radius)
            off[c] = apart
            seen[c] = h, x, y, variance[i, c]
            if not even[i, c] or not near or abs(apart) >= half:
                continue
            reached[i, c] = True
            kept = 0.0
            if weight[c] > 0:
                way = np.sqrt((last[c, 1] - x) ** 2 + (last[c, 2] - y) ** 2)
                kept = weight[c] * np.exp(-way / length)
            weight[c] = kept + 1 / variance[i, c]
            mean[c] += (h - mean[c]) / (variance[i, c] * weight[c])
            last[c] = h, x, y
