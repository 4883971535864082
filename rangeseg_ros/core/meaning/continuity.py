"""Which parts of an image can be one ground: surfaces without a step and not too steep.

The image is cut into cells of one row and some columns; a cell is the mean of its pixels, which
for a plane is a point of the plane (theta . ray = inverse is linear). Along the columns and the
rows, cells at several distances are compared: where the height changes by more than the steepest
ground would over the way between them, there is a step. What remains hangs together or not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import strips

COLUMNS = 8
"""Columns of a cell."""
BASELINES = (1, 2, 4, 8, 16)
"""Rows between cells that are compared."""
# Standard deviations of the noise that a step must exceed: one in 16 000 by chance.
_SIGNIFICANT = 4.0
# Cells without a measurement that a surface may reach across.
_GAP = 3


class Cells(NamedTuple):
    """Means of cells, (rows, columns); nothing is measured where `inverse` is 0.

    Attributes
    ----------
    ray : (..., 3) float32
        Mean ray of the measured pixels.
    inverse : (...) float32
        Their mean inverse range, 1/m.
    halves : (..., 2, 4) float32
        Means of ray and inverse range of the left and the right half; 0 where less than half of
        that is measured.
    """

    ray: NDArray[np.float32]
    inverse: NDArray[np.float32]
    halves: NDArray[np.float32]


def cells_of(inverse: NDArray[np.float32], rays: NDArray[np.float32]) -> Cells:
    """Cells of an image (H, W); at least half of their pixels are measured."""
    height, width = inverse.shape
    shape = height, -(-width // COLUMNS)
    cells = Cells(
        np.zeros((*shape, 3), np.float32),
        np.zeros(shape, np.float32),
        np.zeros((*shape, 2, 4), np.float32),
    )
    strips(_means, height, inverse, rays, cells)
    return cells


@njit(cache=True, nogil=True)
def _means(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    cells: Cells,
) -> None:
    width = inverse.shape[1]
    half = COLUMNS // 2
    for i in range(first, after):
        for c in range(cells.inverse.shape[1]):
            x = y = z = total = np.float32(0)
            count = 0
            for side in range(2):
                start = c * COLUMNS + side * half
                a = b = d = e = np.float32(0)
                n = 0
                for j in range(start, min(start + half, width)):
                    if inverse[i, j] > 0:
                        a += rays[i, j, 0]
                        b += rays[i, j, 1]
                        d += rays[i, j, 2]
                        e += inverse[i, j]
                        n += 1
                if 2 * n >= half:
                    cells.halves[i, c, side, 0] = a / n
                    cells.halves[i, c, side, 1] = b / n
                    cells.halves[i, c, side, 2] = d / n
                    cells.halves[i, c, side, 3] = e / n
                x, y, z, total, count = x + a, y + b, z + d, total + e, count + n
            if 2 * count >= COLUMNS:
                cells.ray[i, c, 0] = x / count
                cells.ray[i, c, 1] = y / count
                cells.ray[i, c, 2] = z / count
                cells.inverse[i, c] = total / count


def noise_of(cells: Cells, deviation: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the cells of this image err by, relative to the sensor model, at each baseline.

    On a plane the inverse range is linear along a column, so that second differences are noise.
    Most cells lie on surfaces that are plane over these distances: the quantile 0.4 of what
    they show, as a standard deviation.

    Parameters
    ----------
    cells : Cells
    deviation : (rows, columns) float64
        Standard deviation of a pixel's inverse range by the sensor model, 1/m.

    Returns
    -------
    (B,) float64, one for each of `BASELINES`.
    """
    value, known = cells.inverse, cells.inverse > 0
    found: list[float] = []
    for step in BASELINES:
        a, b, c = (slice(k * step, len(value) - (2 - k) * step, 3) for k in range(3))
        if len(value) <= 2 * step:
            found.append(found[-1] if found else 1.0)
            continue
        whole = known[a] & known[b] & known[c]
        bend = np.abs(value[a] - 2 * value[b] + value[c])[whole] / deviation[b][whole]
        # Of a normal distribution, 40 % lie within 0.524 standard deviations.
        found.append(float(np.quantile(bend, 0.4)) / 0.524 / np.sqrt(6) if bend.size else 1.0)
    return np.maximum.accumulate(np.maximum(found, 0.05))


@njit(cache=True, nogil=True)
def steps(
    first: int,
    after: int,
    place: NDArray[np.float32],
    error: NDArray[np.float32],
    noise: NDArray[np.float64],
    slope: float,
    least: float,
    steep: NDArray[np.bool_],
    broken: NDArray[np.bool_],
) -> None:
    """Mark the cells of columns first...after that lie in a step, and the links that cross one.

    Parameters
    ----------
    first, after : int
        Columns of cells.
    place : (rows, columns, 3) float32
        Height and horizontal position of the cells, metres; NaN where nothing is measured.
    error : (rows, columns) float32
        Standard deviation of a cell's height by the sensor model, metres.
    noise : (B,) float64
        See `noise_of`.
    slope : float
        Tangent of the steepest ground.
    least : float
        Height that no neighbour on the ground differs by, metres.
    steep : (rows, columns) bool
        Set where a cell lies in a step.
    broken : (rows, columns) bool
        Set where a step is between a cell and the next measured one below.
    """
    rows = len(error)
    for c in range(first, after):
        for b in range(len(BASELINES)):
            k = BASELINES[b]
            factor = _SIGNIFICANT * np.sqrt(2.0) * noise[b]
            for i in range(rows - k):
                if np.isnan(place[i, c, 0]) or np.isnan(place[i + k, c, 0]):
                    continue
                rise = abs(place[i, c, 0] - place[i + k, c, 0])
                way = np.hypot(
                    place[i, c, 1] - place[i + k, c, 1], place[i, c, 2] - place[i + k, c, 2]
                )
                allowed = slope * way + factor * max(error[i, c], error[i + k, c])
                if k <= _GAP:
                    allowed = min(allowed, max(least, factor * max(error[i, c], error[i + k, c])))
                if rise > allowed:
                    if k == 1:
                        broken[i, c] = True
                    # Between the two, and as far as the measurement goes where it ends there.
                    first_cell, after_cell = i + 1, i + k
                    if k > 1 and (i == 0 or np.isnan(place[i - 1, c, 0])):
                        first_cell = i
                    if k > 1 and (i + k + 1 == rows or np.isnan(place[i + k + 1, c, 0])):
                        after_cell = i + k + 1
                    for m in range(first_cell, after_cell):
                        steep[m, c] = True
                        broken[m, c] = True
                    broken[i, c] = True


def divided(
    cells: Cells,
    axes: NDArray[np.float32],
    error: NDArray[np.float32],
    noise: float,
    slope: float,
) -> NDArray[np.bool_]:
    """(rows, columns) whether a step divides the halves of a cell.

    Parameters
    ----------
    cells : Cells
    axes : (3, 3) float32
        Rows: up, and two horizontal directions.
    error, noise, slope
        As for `steps`.
    """
    value = cells.halves[..., 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        place = (cells.halves[..., :3] @ axes.T) / value[..., None]
    apart = np.abs(place[:, :, 0] - place[:, :, 1])
    allowed = slope * np.hypot(apart[..., 1], apart[..., 2]) + _SIGNIFICANT * noise * error
    result: NDArray[np.bool_] = (value > 0).all(axis=2) & (apart[..., 0] > allowed)
    return result


@njit(cache=True, nogil=True)
def components(
    place: NDArray[np.float32],
    error: NDArray[np.float32],
    noise: NDArray[np.float64],
    slope: float,
    least: float,
    steep: NDArray[np.bool_],
    broken: NDArray[np.bool_],
) -> tuple[NDArray[np.int32], int]:
    """Surfaces of cells that no step divides: (rows, columns) 1...N, 0 for none, and N.

    Parameters as for `steps`.
    """
    rows, columns = error.shape
    parent = np.arange(rows * columns)
    for i in range(rows):
        for c in range(columns):
            if np.isnan(place[i, c, 0]) or steep[i, c]:
                continue
            # The next measured cell below.
            if not broken[i, c]:
                for k in range(1, _GAP + 1):
                    if i + k >= rows or steep[i + k, c]:
                        break
                    if not np.isnan(place[i + k, c, 0]):
                        if k == 1 or _level(place, error, noise[1], slope, least, i, c, i + k, c):
                            _join(parent, i * columns + c, (i + k) * columns + c)
                        break
            # The one to the right, where the next but one agrees on either side.
            if c + 1 < columns and _level(place, error, noise[2], slope, least, i, c, i, c + 1):
                here = not steep[i, c + 1]
                for k, m in ((c, c + 2), (c - 1, c + 1)):
                    if k >= 0 and m < columns and not np.isnan(place[i, k, 0] + place[i, m, 0]):
                        here &= _level(place, error, noise[3], slope, least, i, k, i, m)
                if here:
                    _join(parent, i * columns + c, i * columns + c + 1)
    label = np.zeros((rows, columns), np.int32)
    count = 0
    for i in range(rows):
        for c in range(columns):
            if np.isnan(place[i, c, 0]) or steep[i, c]:
                continue
            root = _find(parent, i * columns + c)
            a, b = root // columns, root % columns
            if label[a, b] == 0:
                count += 1
                label[a, b] = count
            label[i, c] = label[a, b]
    return label, count


@njit(cache=True, nogil=True)
def _level(
    place: NDArray[np.float32],
    error: NDArray[np.float32],
    noise: float,
    slope: float,
    least: float,
    i: int,
    c: int,
    k: int,
    m: int,
) -> bool:
    """Whether ground may lead from one cell to the other, both measured."""
    rise = abs(place[i, c, 0] - place[k, m, 0])
    way = np.hypot(place[i, c, 1] - place[k, m, 1], place[i, c, 2] - place[k, m, 2])
    chance = _SIGNIFICANT * np.sqrt(2.0) * noise * max(error[i, c], error[k, m])
    return rise <= min(slope * way + chance, max(least, chance))


@njit(cache=True, nogil=True)
def _find(parent: NDArray[np.int64], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def _join(parent: NDArray[np.int64], i: int, k: int) -> None:
    a, b = _find(parent, i), _find(parent, k)
    # The smaller root, so that the result does not depend on the order.
    parent[max(a, b)] = min(a, b)
