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
from rangeseg_ros.core.meaning.steps import BROAD, Steps
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
# Sums over no cells: tuples, which the compiler keeps in registers.
_NOTHING: tuple[float, ...] = (0.0,) * 10
_NO_CELLS: tuple[float, ...] = (0.0,) * 4
# Bits of the column of a tile in its number, and of its row.
_BITS = 16


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
    ground = seed.copy()
    sums, rest, order = _started(height, cells, candidate, seed)
    order.sort()
    _grow(order, height, cells, candidate, steps, sums, rest, ground)
    return ground


@njit(cache=True, nogil=True)
def _started(
    height: NDArray[np.float32],
    cells: Cells,
    candidate: NDArray[np.bool_],
    seed: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """What the growth starts from.

    Returns
    -------
    sums : (M, columns of tiles + 2, 10) float64
        Of the ground in a block of tiles and those above and below: sums of the regression.
    rest : (rows of tiles + 2 * 2, columns of tiles + 2 * 1, 4) float64
        Of the candidates in a tile that are not ground: their number, and sums of height and
        place. As of `sums`, a rim of zeros has every window the same size, which the compiler
        writes out.
    order : (N,) int64
        Tiles with candidates that are not ground: the distance of the nearest one, then row and
        column. Floats that are not negative are in the order of their bits.
    """
    rows, columns = height.shape
    place = cells.place
    high, wide = -(-rows // ROWS), -(-columns // COLUMNS)
    sums = np.zeros((-(-high // _HIGH), wide + 2, 10))
    rest = np.zeros((high + 2 * _BESIDE[0], wide + 2 * _BESIDE[1], 4))
    distance = np.full((high, wide), np.float32(np.inf))
    for i in range(rows):
        for c in range(columns):
            if seed[i, c]:
                gain = _plus(_NOTHING, height, cells, i, c)
                _add(sums, i // (ROWS * _HIGH), c // COLUMNS, gain)
            elif candidate[i, c]:
                m, n = i // ROWS, c // COLUMNS
                one = _plus_cell(_NO_CELLS, height, place, i, c)
                for k in range(len(one)):
                    rest[m + _BESIDE[0], n + _BESIDE[1], k] += one[k]
                x, y = place[1, i, c], place[2, i, c]
                distance[m, n] = min(distance[m, n], x * x + y * y)
    order = np.empty(high * wide, np.int64)
    bits, count = distance.view(np.int32), 0
    for m in range(high):
        for n in range(wide):
            if rest[m + _BESIDE[0], n + _BESIDE[1], 0] > 0:
                order[count] = (np.int64(bits[m, n]) << 32) | (m << _BITS) | n
                count += 1
    return sums, rest, order[:count]


@njit(cache=True, nogil=True, error_model='numpy')
def _grow(
    order: NDArray[np.int64],
    height: NDArray[np.float32],
    cells: Cells,
    candidate: NDArray[np.bool_],
    steps: Steps,
    sums: NDArray[np.float64],
    rest: NDArray[np.float64],
    ground: NDArray[np.bool_],
) -> None:
    """Grow tile by tile in that order, outwards, and back behind what stands in the way.

    Eight parameters: a kernel that changes three arrays.
    """
    for turn in range(2):
        for k in range(len(order)):
            tile = order[k] if turn == 0 else order[len(order) - 1 - k]
            m, n = (tile >> _BITS) % (1 << _BITS), tile % (1 << _BITS)
            if rest[m + _BESIDE[0], n + _BESIDE[1], 0] > 0:
                _grow_tile(m, n, height, cells, candidate, steps, sums, rest, ground)


@njit(cache=True, inline='always')
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
) -> None:
    """Accept the cells of tile (m, n) that agree with the ground around it, if their mean does.

    Nine parameters: a kernel that changes three arrays.
    """
    w, wx, wy, wxx, wxy, wyy, wh, wxh, wyh, number = _around(sums, m // _HIGH, n)
    if number < _ENOUGH:
        return
    x, y, h = wx / w, wy / w, wh / w
    # The weights are those of the sensor model, which the image shows to err by a factor.
    # It starts from level: steeper than the steepest ground is certainly none.
    prior = (steps.noise[BROAD] * CERTAIN / steps.slope) ** 2
    xx, xy, yy = (
        wxx - w * x * x + prior,
        wxy - w * x * y,
        wyy - w * y * y + prior,
    )
    xh, yh = wxh - w * x * h, wyh - w * y * h
    determinant = xx * yy - xy * xy
    p, q = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
    steepness = np.sqrt(p * p + q * q)
    if steepness > steps.slope:
        p, q = p * steps.slope / steepness, q * steps.slope / steepness
    # Noise lets single cells of a step through, not the mean of what is not yet ground around.
    count = rise = ahead = aside = 0.0
    for i in range(2 * _BESIDE[0] + 1):
        for j in range(2 * _BESIDE[1] + 1):
            count += rest[m + i, n + j, 0]
            rise += rest[m + i, n + j, 1]
            ahead += rest[m + i, n + j, 2]
            aside += rest[m + i, n + j, 3]
    off = rise - count * h - p * (ahead - count * x) - q * (aside - count * y)
    if abs(off) > count * steps.least:
        return
    place = cells.place
    gain, less = _NOTHING, _NO_CELLS
    for i in range(m * ROWS, min((m + 1) * ROWS, height.shape[0])):
        for c in range(n * COLUMNS, min((n + 1) * COLUMNS, height.shape[1])):
            if candidate[i, c] and not ground[i, c]:
                expected = h + p * (place[1, i, c] - x) + q * (place[2, i, c] - y)
                if abs(height[i, c] - expected) <= steps.least:
                    ground[i, c] = True
                    gain = _plus(gain, height, cells, i, c)
                    less = _plus_cell(less, height, place, i, c)
    if less[0] > 0:
        _add(sums, m // _HIGH, n, gain)
        for k in range(len(less)):
            rest[m + _BESIDE[0], n + _BESIDE[1], k] -= less[k]


@njit(cache=True, inline='always')
def _add(sums: NDArray[np.float64], b: int, n: int, gain: tuple[float, ...]) -> None:
    """Add to the sums of a block and of those above and below it."""
    for i in range(max(b - 1, 0), min(b + 2, sums.shape[0])):
        for k in range(len(gain)):
            sums[i, n + 1, k] += gain[k]


@njit(cache=True, inline='always')
def _around(sums: NDArray[np.float64], b: int, n: int) -> tuple[float, ...]:
    """Sums over three blocks by three, one by one, as the compiler keeps numbers in registers."""
    w = x = y = xx = xy = yy = h = xh = yh = number = 0.0
    for j in range(n, n + 3):
        w += sums[b, j, 0]
        x += sums[b, j, 1]
        y += sums[b, j, 2]
        xx += sums[b, j, 3]
        xy += sums[b, j, 4]
        yy += sums[b, j, 5]
        h += sums[b, j, 6]
        xh += sums[b, j, 7]
        yh += sums[b, j, 8]
        number += sums[b, j, 9]
    return w, x, y, xx, xy, yy, h, xh, yh, number


@njit(cache=True, inline='always')
def _plus_cell(
    total: tuple[float, ...],
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    i: int,
    c: int,
) -> tuple[float, ...]:
    """Sums of a tile with one more cell."""
    number, h, x, y = total
    return number + 1.0, h + height[i, c], x + place[1, i, c], y + place[2, i, c]


@njit(cache=True, inline='always')
def _plus(
    total: tuple[float, ...], height: NDArray[np.float32], cells: Cells, i: int, c: int
) -> tuple[float, ...]:
    """Sums of the ground with one more cell."""
    sw, sx, sy, sxx, sxy, syy, sh, sxh, syh, number = total
    w = 1 / max(cells.error[i, c] ** 2, np.float32(1e-10))
    place = cells.place
    x, y, h = place[1, i, c], place[2, i, c], height[i, c]
    return (
        sw + w,
        sx + w * x,
        sy + w * y,
        sxx + w * x * x,
        sxy + w * x * y,
        syy + w * y * y,
        sh + w * h,
        sxh + w * x * h,
        syh + w * y * h,
        number + 1.0,
    )
