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
    sums, rest, distance = _started(height, cells, candidate, seed)
    # Numbers in the order of the distance, and then of the tiles: floats that are not negative
    # are in the order of their bits.
    tiles = np.flatnonzero(rest[..., 0])
    keys = (distance.ravel()[tiles].view(np.int32).astype(np.int64) << 32) | tiles
    keys.sort()
    _grow(keys & 0xFFFFFFFF, height, cells, candidate, steps, sums, rest, ground)
    return ground


@njit(cache=True, nogil=True)
def _started(
    height: NDArray[np.float32],
    cells: Cells,
    candidate: NDArray[np.bool_],
    seed: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
    """What the growth starts from.

    Returns
    -------
    sums : (M, columns of tiles, 10) float64
        Of the ground in a block of tiles: sums of the regression.
    rest : (rows of tiles, columns of tiles, 4) float64
        Of the candidates in a tile that are not ground: their number, and sums of height and
        place.
    distance : (rows of tiles, columns of tiles) float32
        Of the nearest candidate of a tile, squared.
    """
    rows, columns = height.shape
    place = cells.place
    high, wide = -(-rows // ROWS), -(-columns // COLUMNS)
    sums = np.zeros((-(-high // _HIGH), wide, 10))
    rest = np.zeros((high, wide, 4))
    distance = np.full((high, wide), np.float32(np.inf))
    for i in range(rows):
        for c in range(columns):
            if seed[i, c]:
                _add(sums, height, cells, i, c)
            elif candidate[i, c]:
                m, n = i // ROWS, c // COLUMNS
                _count(rest[m, n], height, place, i, c, 1.0)
                x, y = place[1, i, c], place[2, i, c]
                distance[m, n] = min(distance[m, n], x * x + y * y)
    return sums, rest, distance


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
    wide = rest.shape[1]
    for turn in range(2):
        for k in range(len(order)):
            tile = order[k] if turn == 0 else order[len(order) - 1 - k]
            m, n = tile // wide, tile % wide
            if rest[m, n, 0] > 0:
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
    for i in range(max(m - _BESIDE[0], 0), min(m + _BESIDE[0] + 1, rest.shape[0])):
        for j in range(max(n - _BESIDE[1], 0), min(n + _BESIDE[1] + 1, rest.shape[1])):
            count += rest[i, j, 0]
            rise += rest[i, j, 1]
            ahead += rest[i, j, 2]
            aside += rest[i, j, 3]
    off = rise - count * h - p * (ahead - count * x) - q * (aside - count * y)
    if abs(off) > count * steps.least:
        return
    place = cells.place
    for i in range(m * ROWS, min((m + 1) * ROWS, height.shape[0])):
        for c in range(n * COLUMNS, min((n + 1) * COLUMNS, height.shape[1])):
            if candidate[i, c] and not ground[i, c]:
                expected = h + p * (place[1, i, c] - x) + q * (place[2, i, c] - y)
                if abs(height[i, c] - expected) <= steps.least:
                    ground[i, c] = True
                    _add(sums, height, cells, i, c)
                    _count(rest[m, n], height, place, i, c, -1.0)


@njit(cache=True, inline='always')
def _around(sums: NDArray[np.float64], b: int, n: int) -> tuple[float, ...]:
    """Sums over three blocks by three, one by one, as the compiler keeps numbers in registers."""
    w = x = y = xx = xy = yy = h = xh = yh = number = 0.0
    for i in range(max(b - 1, 0), min(b + 2, sums.shape[0])):
        for j in range(max(n - 1, 0), min(n + 2, sums.shape[1])):
            w += sums[i, j, 0]
            x += sums[i, j, 1]
            y += sums[i, j, 2]
            xx += sums[i, j, 3]
            xy += sums[i, j, 4]
            yy += sums[i, j, 5]
            h += sums[i, j, 6]
            xh += sums[i, j, 7]
            yh += sums[i, j, 8]
            number += sums[i, j, 9]
    return w, x, y, xx, xy, yy, h, xh, yh, number


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
    height: NDArray[np.float32],
    cells: Cells,
    i: int,
    c: int,
) -> None:
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
