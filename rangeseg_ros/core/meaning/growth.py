"""The ground grown outwards from under the robot.

Tile by tile, in the order of their distance, a plane through the ground accepted around a tile
tells where its ground must be. A plane of many cells does not leak through a gap in a step, as
links between neighbours do; and it bends into a ramp, but never more than the steepest one.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import Cells
from rangeseg_ros.core.meaning.continuity import BROAD, Steps
from rangeseg_ros.core.meaning.under_robot import NEAR, solve_plane
from rangeseg_ros.core.significance import CERTAIN

ROWS, COLUMNS = 2, 2
"""Cells of a tile, along columns and rows."""
# Tiles on either side of a tile whose mean must agree: about 20 x 48 pixels together, which is
# wider than the correlation of a stereo camera's noise.
_BESIDE = (2, 1)
# Tiles of a block: the window of a prediction is three blocks high and wide.
_HIGH = 4
# Cells that make a prediction: as many as two tiles have.
_ENOUGH = 8
# Cells that tell its plane.
_PLENTY = 300


@njit(cache=True, nogil=True)
def nearest_part(
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    surface: NDArray[np.int32],
    chosen: int,
    tolerance: float,
) -> NDArray[np.bool_]:
    """Cells of a surface nearest to the robot that lie on one plane."""
    rows, columns = surface.shape
    nearest = np.inf
    for i in range(rows):
        for c in range(columns):
            if surface[i, c] == chosen:
                nearest = min(nearest, place[1, i, c] ** 2 + place[2, i, c] ** 2)
    # It is grown from what is near to where it comes into view.
    reach = (np.sqrt(nearest) + NEAR) ** 2
    near = np.zeros((rows, columns), np.bool_)
    count = 0
    for i in range(rows):
        for c in range(columns):
            square = place[1, i, c] ** 2 + place[2, i, c] ** 2
            near[i, c] = surface[i, c] == chosen and square <= reach
            count += near[i, c]
    # Some of them tell the plane as well as all.
    step = max(count // _PLENTY, 1)
    points = np.empty((3, -(-count // step)))
    count = 0
    for i in range(rows):
        for c in range(columns):
            if near[i, c]:
                if count % step == 0:
                    k = count // step
                    points[0, k], points[1, k] = place[1, i, c], place[2, i, c]
                    points[2, k] = height[i, c]
                count += 1
    x, y, h = points[0], points[1], points[2]
    total = np.zeros(9)
    p, q, r = np.median(h), 0.0, 0.0
    for _ in range(3):
        off = np.abs(h - p - q * x - r * y)
        bound = max(tolerance, np.median(off))
        total[:] = 0
        for k in range(len(h)):
            if off[k] <= bound:
                entries = (1.0, x[k], y[k], x[k] * x[k], x[k] * y[k], y[k] * y[k], h[k])
                for n in range(7):
                    total[n] += entries[n]
                total[7] += h[k] * x[k]
                total[8] += h[k] * y[k]
        p, q, r = solve_plane(total, 1e-9, 1e-9)
    for i in range(rows):
        for c in range(columns):
            if near[i, c]:
                off_plane = height[i, c] - p - q * place[1, i, c] - r * place[2, i, c]
                near[i, c] = abs(off_plane) <= tolerance
    return near


@njit(cache=True, nogil=True)
def grown(
    height: NDArray[np.float32],
    cells: Cells,
    candidate: NDArray[np.bool_],
    seed: NDArray[np.bool_],
    steps: Steps,
) -> NDArray[np.bool_]:
    """Cells of the ground.

    Parameters
    ----------
    height : (rows, columns) float32
        Above the plane under the robot, metres.
    cells : Cells
    candidate : (rows, columns) bool
        Cells that no step crosses.
    seed : (rows, columns) bool
        Cells that are ground.
    steps : Steps
        Its `least` is what ground may differ by from its prediction.

    Returns
    -------
    (rows, columns) bool
    """
    rows, columns = height.shape
    place = cells.place
    high, wide = -(-rows // ROWS), -(-columns // COLUMNS)
    # Of the ground in a block: sums of the regression. Of the candidates in a tile that are not
    # ground: their number, and sums of height and place.
    sums = np.zeros((-(-high // _HIGH), wide, 10))
    rest = np.zeros((high, wide, 4))
    ground = np.zeros((rows, columns), np.bool_)
    distance = np.full(high * wide, np.float32(np.inf))
    for i in range(rows):
        for c in range(columns):
            m, n = i // ROWS, c // COLUMNS
            if seed[i, c]:
                _add(sums, ground, height, cells, i, c)
            elif candidate[i, c]:
                _count(rest[m, n], height, place, i, c, 1.0)
            if candidate[i, c]:
                x, y = place[1, i, c], place[2, i, c]
                distance[m * wide + n] = min(distance[m * wide + n], x * x + y * y)
    order = np.argsort(distance, kind='mergesort')
    total = np.empty(10)
    for turn in range(2):  # outwards, and back behind what stands in the way
        for k in range(len(order)):
            tile = order[k] if turn == 0 else order[len(order) - 1 - k]
            m, n = tile // wide, tile % wide
            if rest[m, n, 0] > 0:
                _grow_tile(m, n, height, cells, candidate, steps, sums, rest, ground, total)
    return ground


@njit(cache=True, nogil=True)
def _grow_tile(
    m: int,
    n: int,
    height: NDArray[np.float32],
    cells: Cells,
    candidate: NDArray[np.bool_],
    steps: Steps,
    sums: NDArray[np.float64],
    rest: NDArray[np.float64],
    ground: NDArray[np.bool_],
    total: NDArray[np.float64],
) -> None:
    """Accept the cells of tile (m, n) that agree with the ground around it, if their mean does.

    Ten parameters: a kernel that changes three arrays, and one it need not make each time.
    """
    b = m // _HIGH
    total[:] = 0
    for i in range(max(b - 1, 0), min(b + 2, sums.shape[0])):
        for j in range(max(n - 1, 0), min(n + 2, sums.shape[1])):
            for k in range(10):
                total[k] += sums[i, j, k]
    if total[9] < _ENOUGH:
        return
    w = total[0]
    x, y, h = total[1] / w, total[2] / w, total[6] / w
    # The weights are those of the sensor model, which the image shows to err by a factor.
    # It starts from level: steeper than the steepest ground is certainly none.
    prior = (steps.noise[BROAD] * CERTAIN / steps.slope) ** 2
    xx, xy, yy = (
        total[3] - w * x * x + prior,
        total[4] - w * x * y,
        total[5] - w * y * y + prior,
    )
    xh, yh = total[7] - w * x * h, total[8] - w * y * h
    determinant = xx * yy - xy * xy
    p, q = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
    steepness = np.sqrt(p * p + q * q)
    if steepness > steps.slope:
        p, q = p * steps.slope / steepness, q * steps.slope / steepness
    # Noise lets single cells of a step through, not the mean of what is not yet ground around.
    off, count = 0.0, 0.0
    for i in range(max(m - _BESIDE[0], 0), min(m + _BESIDE[0] + 1, rest.shape[0])):
        for j in range(max(n - _BESIDE[1], 0), min(n + _BESIDE[1] + 1, rest.shape[1])):
            number = rest[i, j, 0]
            count += number
            off += rest[i, j, 1] - number * h
            off -= p * (rest[i, j, 2] - number * x) + q * (rest[i, j, 3] - number * y)
    if abs(off) > count * steps.least:
        return
    place = cells.place
    for i in range(m * ROWS, min((m + 1) * ROWS, height.shape[0])):
        for c in range(n * COLUMNS, min((n + 1) * COLUMNS, height.shape[1])):
            if candidate[i, c] and not ground[i, c]:
                expected = h + p * (place[1, i, c] - x) + q * (place[2, i, c] - y)
                if abs(height[i, c] - expected) <= steps.least:
                    _add(sums, ground, height, cells, i, c)
                    _count(rest[m, n], height, place, i, c, -1.0)


@njit(cache=True, inline='always')
def _count(
    total: NDArray[np.float64],
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    i: int,
    c: int,
    sign: float,
) -> None:
    """Add a cell to the sums of a tile, or take it away."""
    total[0] += sign
    total[1] += sign * height[i, c]
    total[2] += sign * place[1, i, c]
    total[3] += sign * place[2, i, c]


@njit(cache=True, inline='always')
def _add(
    sums: NDArray[np.float64],
    ground: NDArray[np.bool_],
    height: NDArray[np.float32],
    cells: Cells,
    i: int,
    c: int,
) -> None:
    ground[i, c] = True
    total = sums[i // (ROWS * _HIGH), c // COLUMNS]
    w = 1 / max(cells.error[i, c] ** 2, np.float32(1e-10))
    place = cells.place
    x, y, h = place[1, i, c], place[2, i, c], height[i, c]
    total[0] += w
    total[1] += w * x
    total[2] += w * y
    total[3] += w * x * x
    total[4] += w * x * y
    total[5] += w * y * y
    total[6] += w * h
    total[7] += w * x * h
    total[8] += w * y * h
    total[9] += 1
