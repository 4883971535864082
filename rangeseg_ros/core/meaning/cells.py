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


@njit(cache=True, nogil=True, error_model='numpy')
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
    # Of the left and the right half of a cell: sums of rays and inverse ranges, and their number.
    sums = np.zeros((5, 2), np.float32)
    mean = np.zeros(3, np.float32)
    up, ahead, across = axes[0], axes[1], axes[2]
    for i in range(first, after):
        for c in range(cells.inverse.shape[1]):
            for side in range(2):
                start = c * size.columns + side * half
                x = y = z = total = number = np.float32(0)
                for v in range(i * size.rows, min((i + 1) * size.rows, inverse.shape[0])):
                    for j in range(start, min(start + half, inverse.shape[1])):
                        # No branch, so that the compiler makes them vector instructions.
                        one = np.float32(1) if inverse[v, j] > 0 else np.float32(0)
                        x += one * rays[v, j, 0]
                        y += one * rays[v, j, 1]
                        z += one * rays[v, j, 2]
                        total += inverse[v, j]
                        number += one
                sums[0, side], sums[1, side], sums[2, side] = x, y, z
                sums[3, side], sums[4, side] = total, number
            count = sums[4, 0] + sums[4, 1]
            if 2 * count < size.rows * size.columns:
                continue
            value = (sums[3, 0] + sums[3, 1]) / count
            cells.inverse[i, c] = value
            for k in range(3):
                mean[k] = (sums[k, 0] + sums[k, 1]) / count
                cells.ray[i, c, k] = mean[k]
            for k in range(3):
                cells.place[i, c, k] = (
                    axes[k, 0] * mean[0] + axes[k, 1] * mean[1] + axes[k, 2] * mean[2]
                ) / value
            deviation = np.sqrt(random_variance(sensor, value * value))
            cells.error[i, c] = abs(cells.place[i, c, 0]) / value * deviation
            if min(sums[4, 0], sums[4, 1]) * 4 >= size.rows * size.columns:
                x, y = _apart(ahead, sums), _apart(across, sums)
                cells.kink[i, c, 0] = abs(_apart(up, sums))
                cells.kink[i, c, 1] = np.sqrt(x * x + y * y)


@njit(cache=True, inline='always')
def _apart(axis: NDArray[np.float32], sums: NDArray[np.float32]) -> np.float32:
    """Along an axis, how far the left half of a cell is from the right one."""
    left = axis[0] * sums[0, 0] + axis[1] * sums[1, 0] + axis[2] * sums[2, 0]
    right = axis[0] * sums[0, 1] + axis[1] * sums[1, 1] + axis[2] * sums[2, 1]
    return left / sums[3, 0] - right / sums[3, 1]
