"""Cells of a few pixels: what the ground is looked for in.

A cell is the mean of its pixels, which for a plane is a point of the plane: theta . ray = inverse
is linear. Cells are wider than high, because the ground recedes along the columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import strips
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
    strips(_means, shape[0], image.inverse, image.rays, size, axes, sensor, cells)
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
    height, width = inverse.shape
    half = size.columns // 2
    sums = np.zeros((2, 5), np.float32)
    for i in range(first, after):
        for c in range(cells.inverse.shape[1]):
            sums[:] = 0
            for v in range(i * size.rows, min((i + 1) * size.rows, height)):
                for side in range(2):
                    start = c * size.columns + side * half
                    for j in range(start, min(start + half, width)):
                        if inverse[v, j] > 0:
                            sums[side, 0] += rays[v, j, 0]
                            sums[side, 1] += rays[v, j, 1]
                            sums[side, 2] += rays[v, j, 2]
                            sums[side, 3] += inverse[v, j]
                            sums[side, 4] += 1
            count = sums[0, 4] + sums[1, 4]
            if 2 * count < size.rows * size.columns:
                continue
            value = (sums[0, 3] + sums[1, 3]) / count
            cells.inverse[i, c] = value
            for k in range(3):
                cells.ray[i, c, k] = (sums[0, k] + sums[1, k]) / count
            for k in range(3):
                cells.place[i, c, k] = _along(axes[k], sums[0] + sums[1])
            deviation = np.sqrt(random_variance(sensor, value * value))
            cells.error[i, c] = abs(cells.place[i, c, 0]) / value * deviation
            if min(sums[0, 4], sums[1, 4]) * 4 >= size.rows * size.columns:
                apart = [_along(axes[k], sums[0]) - _along(axes[k], sums[1]) for k in range(3)]
                cells.kink[i, c, 0] = abs(apart[0])
                cells.kink[i, c, 1] = np.hypot(apart[1], apart[2])


@njit(cache=True, inline='always')
def _along(axis: NDArray[np.float32], sums: NDArray[np.float32]) -> float:
    """Coordinate along an axis of the point of summed rays and inverse ranges."""
    return (axis[0] * sums[0] + axis[1] * sums[1] + axis[2] * sums[2]) / sums[3]
