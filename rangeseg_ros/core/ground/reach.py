"""Ground is reached if a chain of ground cells leads from the robot to it.

Cells beside no step and on no slope are visited from near to far. The expected height of a cell is
the mean of the cells reached last in its own column and those beside it, where each column keeps
an exponential moving average: so a chain can go around an obstacle. The offset of a column that
leaves the ground fades with distance: noise that hides an edge farther away leads no chain across.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Mask
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.estimate import HIGHEST_STEP
from rangeseg_ros.core.runtime.threads import Task
from rangeseg_ros.core.significance import CLEARLY, OUTLIER

# Columns on either side whose ground leads to a cell.
_NEIGHBOURS = 4
# Cells, as powers of two, over which a slope is measured along rows and columns.
_BASELINES = 6


def reach(place: Floats, variance: Floats, config: Config) -> Mask:
    """Cells (rows, columns) that a chain leads to.

    `place` (3, rows, columns) is height and horizontal position, metres, NaN where nothing is
    measured, with the nearest row first; `variance` that of the height, 0 for cells that are no
    part of a chain. `robot_radius` says how far ground is looked for that leads to a cell, and how
    much farther than the nearest ground in view a chain begins.
    """
    step, slope, radius = config.least_step, config.steepest, config.robot_radius
    across = Task(_without_steps, 1, place, variance, step, slope)
    even = _without_steps(0, place, variance, step, slope) & across.result()
    reached = np.zeros(even.shape, np.bool_)
    if not even.any():
        return reached
    # Where the ground comes into view, no farther than the robot is wide from the nearest of it,
    # and no step above or below most of that. It is near height 0, if anything is.
    begin = even & (np.abs(place[0]) < HIGHEST_STEP)
    begin = begin if begin.any() else even
    front, columns = begin.argmax(axis=0), np.arange(even.shape[1])
    h, x, y = place[:, front, columns]
    distance = np.where(begin.any(axis=0), np.hypot(x, y), np.inf)
    near = distance <= distance.min() + radius
    start = near & (np.abs(h - np.median(h[near])) < step / 2)
    reached[front[start], columns[start]] = True
    _spread(place, variance, even, step / 2, slope, config.ground_gap, radius, reached)
    return reached


@njit(cache=True, nogil=True, error_model='numpy')
def _without_steps(axis: int, place: Floats, variance: Floats, step: float, slope: float) -> Mask:
    """Measured cells (rows, columns) that are beside no step and on no slope along an axis.

    A step is between cells side by side, whatever they are, so that the foot of a wall is none of
    the ground; one that is blurred over two cells leaves the cell between. A slope rises or falls
    twice in three cells; where they lie on a line, all three are on it, else the middle one. The
    shortest way that noise lets tell a cell of no slope decides: a longer one may lead from a wall
    over the ground into a hole.
    """
    _, rows, columns = place.shape
    even = variance > 0
    # Of each cell the shortest baseline over which it is known to be on no slope.
    flat = np.full(even.shape, _BASELINES)
    for e in range(_BASELINES):
        down, right = (1 << e, 0) if axis == 0 else (0, 1 << e)
        for i in range(rows - down):
            for c in range(columns - right):
                k, m = i + down, c + right
                if not variance[i, c] * variance[k, m] > 0:
                    continue
                up = place[0, k, m] - place[0, i, c]
                x, y = place[1, k, m] - place[1, i, c], place[2, k, m] - place[2, i, c]
                way = np.sqrt(x * x + y * y)
                over = abs(up) - slope * way
                noise = OUTLIER * np.sqrt(variance[i, c] + variance[k, m])
                # Beyond an edge the ground is hidden: what is next is farther than it is deep.
                if (e == 0 or way < step) and over > noise + step / 8:
                    even[i, c] = even[k, m] = False
                p, q = k + down, m + right
                if flat[k, m] < e or p >= rows or q >= columns or not variance[p, q] > 0:
                    continue
                rest = place[0, p, q] - place[0, k, m]
                x, y = place[1, p, q] - place[1, k, m], place[2, p, q] - place[2, k, m]
                on = np.sqrt(x * x + y * y)
                beyond = abs(rest) - slope * on
                noise = CLEARLY * np.sqrt(variance[i, c] + variance[p, q])
                if max(over, beyond) < -noise:
                    flat[k, m] = e
                elif up * rest > 0 and min(over, beyond) > 0 and over + beyond > noise:
                    even[k, m] = False
                    if abs(up * on - rest * way) < noise * (way + on):
                        even[i, c] &= flat[i, c] < e
                        even[p, q] &= flat[p, q] < e
    return even


@njit(cache=True, nogil=True, error_model='numpy')
def _spread(
    place: Floats,
    variance: Floats,
    even: Mask,
    half: float,
    slope: float,
    gap: float,
    radius: float,
    reached: Mask,
) -> None:
    """Add to where chains start what they reach, with the nearest row first."""
    rows, columns = variance.shape
    # The steepest ground rises by a quarter of a step over the length of the mean: its lag behind
    # a slope that begins, the noise, and half a step are told apart.
    length = half / 2 / slope
    # Of each column: weight, mean, and where the cell is that was reached last; how far what is
    # seen is off the ground that leads to it, and where that was seen last.
    weight, mean, off = np.zeros(columns), np.zeros(columns), np.zeros(columns)
    last, seen = np.full((columns, 3), np.nan), np.full((columns, 4), np.nan)
    for i in range(rows):
        # Both ways along a row: a cell that nothing leads to from the left, from the right.
        for n in range(2 * columns):
            c = n if n < columns else 2 * columns - 1 - n
            if not variance[i, c] > 0 or (n >= columns and reached[i, c]):
                continue
            h, x, y = place[0, i, c], place[1, i, c], place[2, i, c]
            if reached[i, c]:
                apart, nearest = 0.0, 0.0
            else:
                total = summed = 0.0
                nearest = np.inf
                for q in range(max(c - _NEIGHBOURS, 0), min(c + _NEIGHBOURS + 1, columns)):
                    square = (last[q, 1] - x) ** 2 + (last[q, 2] - y) ** 2
                    if square <= radius * radius:
                        nearest = min(nearest, square)
                        total += weight[q]
                        summed += weight[q] * mean[q]
                if total == 0:
                    continue
                apart = h - summed / total
            near = abs(apart) < half and nearest <= gap * gap
            way = np.sqrt((seen[c, 1] - x) ** 2 + (seen[c, 2] - y) ** 2)
            # Over a wall, or beyond an edge, it is another surface.
            noise = np.sqrt(variance[i, c] + seen[c, 3])
            if abs(h - seen[c, 0]) < slope * way + CLEARLY * noise and way < radius:
                apart += (off[c] - apart) * np.exp(-way / radius)
            leads = even[i, c] and near and abs(apart) < half
            if not leads and n < columns:
                continue
            off[c] = apart
            seen[c, 0], seen[c, 1], seen[c, 2], seen[c, 3] = h, x, y, variance[i, c]
            if not leads:
                continue
            reached[i, c] = True
            kept = 0.0
            if weight[c] > 0:
                way = np.sqrt((last[c, 1] - x) ** 2 + (last[c, 2] - y) ** 2)
                kept = weight[c] * np.exp(-way / length)
            weight[c] = kept + 1 / variance[i, c]
            mean[c] += (h - mean[c]) / (variance[i, c] * weight[c])
            last[c, 0], last[c, 1], last[c, 2] = h, x, y
