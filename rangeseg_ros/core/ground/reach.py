"""Ground is reached if a chain of ground cells leads from the robot to it.

Cells beside no step and on no slope are visited from near to far and back, around obstacles. Each
gets the height of the ground there: the weighted mean of what its own column and those beside it
have, a moving average where they are ground. What is off it is so as far as its surface goes:
noise that hides an edge leads no chain across.
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


def reach(place: Floats, variance: Floats, config: Config, body: bool = False) -> Mask:
    """Cells (rows, columns) that a chain leads to.

    `place` (3, rows, columns) is height and horizontal position, metres, NaN where nothing is
    measured, with the nearest row first; `variance` that of the height, 0 for cells that are no
    part of a chain. `robot_radius` says how far ground is looked for that leads to a cell, and how
    far from the nearest ahead, or where a `body` is in view also beside that, a chain begins.
    """
    step, slope, radius = config.least_step, config.steepest, config.robot_radius
    across = Task(_without_steps, 1, place, variance, step, slope)
    even = _without_steps(0, place, variance, step, slope) & across.result()
    reached = np.zeros(even.shape, np.bool_)
    if not even.any():
        return reached
    # Where the ground comes into view, straight ahead if it does: no farther from the nearest
    # of it than the robot is wide, no step off most of it, and near height 0 if any of it is.
    begin = even & (np.abs(place[0]) < HIGHEST_STEP)
    begin = begin if begin.any() else even
    front, columns = begin.argmax(axis=0), np.arange(even.shape[1])
    h, x, y = place[:, front, columns]
    distance = np.where(begin.any(axis=0), np.hypot(x, y), np.inf)
    ahead = (np.abs(y) <= radius) & (distance <= distance.min() + radius)
    nearest = np.lexsort((distance, ~ahead))[0]
    start = distance <= distance.min() + radius
    start &= body | (np.hypot(x - x[nearest], y - y[nearest]) <= radius)
    start &= np.abs(h - np.median(h[start])) < step / 2
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
    """Add to where chains start what they reach, from the nearest row to the last and back."""
    rows, columns = variance.shape
    # The steepest ground rises by a quarter of a step over the length of the mean: its lag behind
    # a slope that begins, the noise, and half a step are told apart.
    length = half / 2 / slope
    # Of each column: height of the ground, its weight, and the last cell, visited or reached.
    level, weight = np.zeros(columns), np.zeros(columns)
    visited, ground = np.full((columns, 2), np.nan), np.full((columns, 2), np.nan)
    # Height and row of what was seen off the ground last; what was stays so when chains come back.
    surface, row = np.full(columns, np.nan), np.zeros(columns, np.intp)
    rejected = np.zeros(reached.shape, np.bool_)
    for k in range(2 * rows):
        i = min(k, 2 * rows - 1 - k)
        # Both ways along a row; what cannot be reached gets its ground on the way back.
        for n in range(2 * columns):
            c = n if n < columns else 2 * columns - 1 - n
            free = even[i, c] and not rejected[i, c]
            if not variance[i, c] > 0 or (reached[i, c] if n >= columns else not free):
                continue
            h, x, y, apart = place[0, i, c], place[1, i, c], place[2, i, c], 0.0
            if not reached[i, c]:
                noise, total, summed, count = CLEARLY * np.sqrt(variance[i, c]), 0.0, 0.0, 0
                nearest = closest = np.inf
                for q in range(max(c - _NEIGHBOURS, 0), min(c + _NEIGHBOURS + 1, columns)):
                    square = (ground[q, 0] - x) ** 2 + (ground[q, 1] - y) ** 2
                    nearest = square if square < nearest else nearest
                    square = (visited[q, 0] - x) ** 2 + (visited[q, 1] - y) ** 2
                    if not square <= radius * radius:
                        continue
                    count, closest = count + 1, min(closest, square)
                    total += weight[q]
                    summed += weight[q] * level[q]
                    # Of the surface that is off the ground: it is off by as much.
                    if even[i, c] and abs(i - row[q]) <= 1 and abs(h - surface[q]) < half + noise:
                        summed += weight[q] * (h - surface[q])
                if count == 0:
                    continue
                apart = abs(h - summed / total)
                if not (free and nearest <= gap * gap and apart < half):
                    if n >= columns:
                        off = apart > half + noise
                        rejected[i, c] |= off
                        level[c], weight[c] = summed / total, total / count
                        if not off:
                            weight[c] *= np.exp(-np.sqrt(closest) / radius)
                        visited[c, 0], visited[c, 1] = x, y
                        surface[c], row[c] = h if off and even[i, c] else np.nan, i
                    continue
            reached[i, c], surface[c] = True, np.nan
            way = np.sqrt((visited[c, 0] - x) ** 2 + (visited[c, 1] - y) ** 2)
            kept = weight[c] * np.exp(-way / length) if weight[c] > 0 else 0.0
            # The less the farther off (Cauchy's weight): a blurred edge leads down in two halves.
            own = 1 / (variance[i, c] * (1 + (apart / half) ** 2))
            weight[c] = kept + own
            level[c] += (h - level[c]) * own / weight[c]
            visited[c, 0], visited[c, 1] = x, y
            ground[c, 0], ground[c, 1] = x, y
