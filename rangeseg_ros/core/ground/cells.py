"""Cells of a few pixels: what the ground is looked for in.

A cell is the mean of its pixels, which for a plane is a point of the plane: theta . ray = inverse
is linear. Cells are wider than high, because the ground recedes along the columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import first_rays, next_rays
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance

# Rows of an image whose cells are 1 x 4 pixels.
_ROWS = 240


class CellSize(NamedTuple):
    """Pixels of a cell along the columns and the rows."""

    rows: int
    columns: int

    @classmethod
    def of(cls, shape: tuple[int, int]) -> CellSize:
        """2 x 8 for 640 x 480, more for larger images, 1 x 4 for small ones."""
        rows = max(shape[0] // _ROWS, 1)
        return cls(rows, 4 * rows)


class Cells(NamedTuple):
    """Means of the pixels of cells, (rows, columns).

    Attributes
    ----------
    ray : (3, ...) float32
        Mean ray of the measured pixels.
    inverse : (...) float32
        Their mean inverse range, 1/m; 0 where less than half of them are measured.
    place : (3, ...) float32
        Height above the sensor along up, and position along two horizontal directions, metres;
        NaN where not measured.
    error : (...) float32
        Standard deviation of the height, metres, by the sensor model for one pixel.
    """

    ray: NDArray[np.float32]
    inverse: NDArray[np.float32]
    place: NDArray[np.float32]
    error: NDArray[np.float32]


def axes_of(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) up and two horizontal directions, the first along the optical axis if it can be."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([0.0, -1.0, 0.0])
    flat = axis - (axis @ up) * up
    x, y, z = up
    a, b, c = ahead = flat / np.linalg.norm(flat)
    # The cross product, which numpy takes longer for than for all cells.
    return np.array([up, ahead, (y * c - z * b, z * a - x * c, x * b - y * a)])


def cells_of(
    image: RangeImage, size: CellSize, up: NDArray[np.float64], sensor: SensorModel
) -> Cells:
    """Cells of an image.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    size : CellSize
    up : (3,) float64
        Unit vector in the frame of the image.
    sensor : SensorModel
    """
    height, width = image.shape
    shape = -(-height // size.rows), -(-width // size.columns)
    single, several = (np.empty((n, *shape), np.float32) for n in (2, 6))
    cells = Cells(several[:3], single[0], several[3:], single[1])
    axes = axes_of(up).astype(np.float32)
    run_rows(_means, shape[0], image.inverse, image.rays, image.pinhole, size, axes, sensor, cells)
    return cells


@njit(cache=True, nogil=True, error_model='numpy')
def _means(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    size: CellSize,
    axes: NDArray[np.float32],
    sensor: SensorModel,
    cells: Cells,
) -> None:
    """Rows first...after of cells.

    Nine parameters, as a kernel cannot return what several threads write.
    """
    width = inverse.shape[1]
    # Of the pixels of a column: the sum of their inverse ranges, and how many are measured.
    total, number = np.empty((2, cells.inverse.shape[1] * size.columns), np.float32)
    # Of the left and the right halves: sums of rays and inverse ranges, and their number.
    sums = np.empty((5, 2, cells.inverse.shape[1]), np.float32)
    upper, lower = first_rays(rays, first * size.rows), first_rays(rays, first * size.rows)
    # The same of rays as if all pixels were measured, and half the pixels of a half.
    half = np.float32(0.5) * np.float32(size.rows * (size.columns // 2))
    all_rays = np.empty((3, 2, cells.inverse.shape[1]), np.float32)
    for i in range(first, after):
        top, bottom = i * size.rows, min((i + 1) * size.rows, inverse.shape[0])
        total[:], number[:] = 0, 0
        for v in range(top, bottom):
            for j in range(width):
                total[j] += inverse[v, j]
                number[j] += np.float32(1) if inverse[v, j] > 0 else np.float32(0)
        next_rays(rays, pinhole, top, upper)
        next_rays(rays, pinhole, bottom - 1, lower)
        for k in range(3):
            if not pinhole or i == first:
                _add_rays(size, upper[k], lower[k], all_rays[k])
            elif k == 1:  # the same in a whole row
                all_rays[k] = (upper[k, 0] + lower[k, 0]) * half
        _add_halves(size, total, number, sums)
        _add_single(top, bottom, inverse, rays, size, all_rays, sums)
        _divide(i, sums, size, axes, sensor, cells)


@njit(cache=True, inline='always')
def _add_halves(
    size: CellSize,
    total: NDArray[np.float32],
    number: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Sums of half cells from those of columns.

    Two columns at once, as halves are multiples of two wide, with indices that have no sign.
    """
    one, two, pairs = np.uint64(1), np.uint64(2), np.uint64(size.columns // 4)
    for k in range(2):
        source = total if k == 0 else number
        for c in range(sums.shape[2]):
            for side in range(2):
                j = np.uint64(2 * c + side) * two * pairs
                value = source[j] + source[j + one]
                for _ in range(pairs - one):
                    j += two
                    value = (value + source[j]) + source[j + one]
                sums[3 + k, side, c] = value


@njit(cache=True, inline='always')
def _add_rays(
    size: CellSize,
    upper: NDArray[np.float32],
    lower: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Sums of one coordinate over half cells, from the first and the last row of the cells.

    Over so few pixels rays change evenly.
    """
    half, last = size.columns // 2, len(upper) - 1
    share = np.float32(0.5) * np.float32(size.rows * half)
    for side in range(2):
        for c in range(sums.shape[1]):
            left = c * size.columns + side * half
            ends = upper[min(left, last)] + lower[min(left + half - 1, last)]
            sums[side, c] = ends * share


@njit(cache=True, inline='always')
def _add_single(
    top: int,
    bottom: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    size: CellSize,
    all_rays: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Sums of the rays of half cells, one by one where not all or none are measured."""
    half, width = size.columns // 2, inverse.shape[1]
    whole, none = np.float32(size.rows * half), np.float32(0)
    for side in range(2):
        number = sums[4, side]
        for k in range(3):
            total, whole_total = sums[k, side], all_rays[k, side]
            for c in range(len(total)):
                total[c] = whole_total[c] if number[c] == whole else none
    for side in range(2):
        number = sums[4, side]
        for c in range(len(number)):
            if number[c] == whole or number[c] == none:
                continue
            left = c * size.columns + side * half
            x = y = z = none
            for v in range(top, bottom):
                for j in range(left, min(left + half, width)):
                    if inverse[v, j] > 0:
                        x += rays[v, j, 0]
                        y += rays[v, j, 1]
                        z += rays[v, j, 2]
            sums[0, side, c], sums[1, side, c], sums[2, side, c] = x, y, z


@njit(cache=True, inline='always')
def _divide(
    i: int,
    sums: NDArray[np.float32],
    size: CellSize,
    axes: NDArray[np.float32],
    sensor: SensorModel,
    cells: Cells,
) -> None:
    """Row i of cells from the sums of their halves.

    Short loops without a branch, which the compiler makes vector instructions.
    """
    columns = sums.shape[2]
    fewest = np.float32(size.rows * size.columns / 2)
    none, nothing = np.float32(0), np.float32(np.nan)
    count, value = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for c in range(columns):
        count[c] = sums[4, 0, c] + sums[4, 1, c]
        enough = count[c] >= fewest
        value[c] = (sums[3, 0, c] + sums[3, 1, c]) / count[c] if enough else nothing
    for c in range(columns):
        cells.inverse[i, c] = value[c] if value[c] > none else none
    for k in range(3):
        for c in range(columns):
            cells.ray[k, i, c] = (sums[k, 0, c] + sums[k, 1, c]) / count[c]
    for k in range(3):
        x, y, z = axes[k]
        for c in range(columns):
            along = x * cells.ray[0, i, c] + y * cells.ray[1, i, c] + z * cells.ray[2, i, c]
            cells.place[k, i, c] = along / value[c]
    for c in range(columns):
        deviation = np.sqrt(np.float32(random_variance(sensor, value[c] * value[c])))
        error = abs(cells.place[0, i, c]) / value[c] * deviation
        cells.error[i, c] = error if value[c] > none else none
