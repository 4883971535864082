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
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance

# Rows and columns of an image whose cells are 1 x 8 pixels.
_ROWS, _COLUMNS = 480, 480


class CellSize(NamedTuple):
    """Pixels of a cell along the columns and the rows."""

    rows: int
    columns: int

    @classmethod
    def of(cls, shape: tuple[int, int]) -> CellSize:
        """1 x 8 for 640 x 480, more for larger images, 1 x 4 for small ones."""
        rows = max(shape[0] // _ROWS, 1)
        return cls(rows, 8 * rows if shape[1] >= _COLUMNS else 4)


class Cells(NamedTuple):
    """Means of the pixels of cells, (rows, columns).

    Attributes
    ----------
    ray : (..., 3) float32
        Mean ray of the measured pixels.
    inverse : (...) float32
        Their mean inverse range, 1/m; 0 where less than half of them are measured.
    place : (..., 3) float32
        Height above the sensor along up, and position along two horizontal directions, metres;
        NaN where not measured.
    error : (...) float32
        Standard deviation of the height, metres, by the sensor model for one pixel.
    kink : (..., 2) float32
        Difference of height between the left and the right half, and the way between them,
        metres.
    """

    ray: NDArray[np.float32]
    inverse: NDArray[np.float32]
    place: NDArray[np.float32]
    error: NDArray[np.float32]
    kink: NDArray[np.float32]


def axes_of(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) up and two horizontal directions, the first along the optical axis if it can be."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([0.0, -1.0, 0.0])
    flat = axis - (axis @ up) * up
    ahead = flat / np.linalg.norm(flat)
    return np.stack([up, ahead, np.cross(up, ahead)])


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
    cells = Cells(
        np.zeros((*shape, 3), np.float32),
        np.zeros(shape, np.float32),
        np.full((*shape, 3), np.nan, np.float32),
        np.zeros(shape, np.float32),
        np.zeros((*shape, 2), np.float32),
    )
    axes = axes_of(up).astype(np.float32)
    run_rows(_means, shape[0], image.inverse, image.rays, size, axes, sensor, cells)
    return cells


@njit(cache=True, nogil=True)
def _means(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    size: CellSize,
    axes: NDArray[np.float32],
    sensor: SensorModel,
    cells: Cells,
) -> None:
    half = size.columns // 2
    # Of the left and the right half: sums of rays and inverse ranges, and their number.
    sums = np.zeros((2, 5), np.float32)
    for i in range(first, after):
        for c in range(cells.inverse.shape[1]):
            for side in range(2):
                _sum(inverse, rays, i, c * size.columns + side * half, size.rows, half, sums[side])
            count = sums[0, 4] + sums[1, 4]
            if 2 * count < size.rows * size.columns:
                continue
            value = (sums[0, 3] + sums[1, 3]) / count
            cells.inverse[i, c] = value
            for k in range(3):
                cells.ray[i, c, k] = (sums[0, k] + sums[1, k]) / count
            ray = cells.ray[i, c]
            for k in range(3):
                cells.place[i, c, k] = _dot(axes[k], ray) / value
            deviation = np.sqrt(random_variance(sensor, value * value))
            cells.error[i, c] = abs(cells.place[i, c, 0]) / value * deviation
            if min(sums[0, 4], sums[1, 4]) * 4 >= size.rows * size.columns:
                left, right = sums[0, 3], sums[1, 3]
                up, ahead, across = (
                    _dot(axes[0], sums[0]) / left - _dot(axes[0], sums[1]) / right,
                    _dot(axes[1], sums[0]) / left - _dot(axes[1], sums[1]) / right,
                    _dot(axes[2], sums[0]) / left - _dot(axes[2], sums[1]) / right,
                )
                cells.kink[i, c, 0] = abs(up)
                cells.kink[i, c, 1] = np.sqrt(ahead * ahead + across * across)


@njit(cache=True, inline='always')
def _sum(
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    row: int,
    start: int,
    rows: int,
    columns: int,
    total: NDArray[np.float32],
) -> None:
    """Sum what is measured in `rows` x `columns` pixels of row `row` of cells."""
    x = y = z = value = count = np.float32(0)
    for v in range(row * rows, min((row + 1) * rows, inverse.shape[0])):
        for j in range(start, min(start + columns, inverse.shape[1])):
            if inverse[v, j] > 0:
                x += rays[v, j, 0]
                y += rays[v, j, 1]
                z += rays[v, j, 2]
                value += inverse[v, j]
                count += np.float32(1)
    total[0], total[1], total[2], total[3], total[4] = x, y, z, value, count


@njit(cache=True, inline='always')
def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
