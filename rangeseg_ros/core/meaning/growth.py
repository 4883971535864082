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

ROWS, COLUMNS = 2, 2
"""Cells of a tile, along columns and rows."""
# Tiles on either side of a tile whose mean must agree: about 20 x 48 pixels together, which is
# wider than the correlation of a stereo camera's noise.
_BESIDE = (2, 1)
# Tiles of a block: the window of a prediction is three blocks high and wide.
_HIGH = 4
# Cells that make a prediction: as many as two tiles have.
_ENOUGH = 8
# Spread of the ground's slope that a prediction starts from: that of undulation.
_SLOPE = 0.05


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
    sums = np.zeros((-(-high // _HIGH), wide, 10))
    ground = np.zeros((rows, columns), np.bool_)
    distance = np.full(high * wide, np.inf)
    for i in range(rows):
        for c in range(columns):
            if seed[i, c]:
                _add(sums, ground, height, cells, i, c)
            if candidate[i, c]:
                tile = (i // ROWS) * wide + c // COLUMNS
                x, y = place[i, c, 1], place[i, c, 2]
                reach = np.sqrt(x * x + y * y)
                distance[tile] = min(distance[tile], reach)
    order = np.argsort(distance, kind='mergesort')
    total = np.empty(10)
    for turn in range(2):  # outwards, and back behind what stands in the way
        for k in range(len(order)):
            tile = order[k] if turn == 0 else order[len(order) - 1 - k]
            if distance[tile] < np.inf:
                _grow_tile(
                    tile // wide,
                    tile % wide,
                    height,
                    cells,
                    candidate,
                    steps,
                    sums,
                    ground,
                    total,
                )
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
    ground: NDArray[np.bool_],
    total: NDArray[np.float64],
) -> None:
    """Accept the cells of tile (m, n) that agree with the ground around it, if their mean does."""
    if not _open(m, n, candidate, ground):
        return
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
    prior = (steps.noise[BROAD] / _SLOPE) ** 2
    xx, xy, yy = (
        total[3] - w * x * x + prior,
        total[4] - w * x * y,
        total[5] - w * y * y + prior,
    )
    xh, yh = total[7] - w * x * h, total[8] - w * y * h
    determinant = xx * yy - xy * xy
    p, q = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
    steepness = np.hypot(p, q)
    if steepness > steps.slope:
        p, q = p * steps.slope / steepness, q * steps.slope / steepness
    place = cells.place
    # Noise lets single cells of a step through, not the mean of what is not yet ground around.
    off, count = 0.0, 0
    first, after = max(m - _BESIDE[0], 0) * ROWS, (m + _BESIDE[0] + 1) * ROWS
    left, right = max(n - _BESIDE[1], 0) * COLUMNS, (n + _BESIDE[1] + 1) * COLUMNS
    for i in range(first, min(after, height.shape[0])):
        for c in range(left, min(right, height.shape[1])):
            if candidate[i, c] and not ground[i, c]:
                off += height[i, c] - h - p * (place[i, c, 1] - x) - q * (place[i, c, 2] - y)
                count += 1
    if abs(off) > count * steps.least:
        return
    for i in range(m * ROWS, min((m + 1) * ROWS, height.shape[0])):
        for c in range(n * COLUMNS, min((n + 1) * COLUMNS, height.shape[1])):
            if candidate[i, c] and not ground[i, c]:
                expected = h + p * (place[i, c, 1] - x) + q * (place[i, c, 2] - y)
                if abs(height[i, c] - expected) <= steps.least:
                    _add(sums, ground, height, cells, i, c)


@njit(cache=True, inline='always')
def _open(m: int, n: int, candidate: NDArray[np.bool_], ground: NDArray[np.bool_]) -> bool:
    """Whether tile (m, n) has cells that may become ground."""
    for i in range(m * ROWS, min((m + 1) * ROWS, ground.shape[0])):
        for c in range(n * COLUMNS, min((n + 1) * COLUMNS, ground.shape[1])):
            if candidate[i, c] and not ground[i, c]:
                return True
    return False


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
    x, y, h = place[i, c, 1], place[i, c, 2], height[i, c]
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
