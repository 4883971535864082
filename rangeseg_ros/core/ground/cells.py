"""Cells of a few pixels: what the ground is looked for in.

A cell is the mean of its pixels, which for a plane is a point of the plane: theta . ray = inverse
is linear. Cells are wider than high, because the ground recedes along the columns.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.moments import ray_of
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.significance import OUTLIER

# Rows of an image whose cells are 1 x 2 pixels.
_ROWS = 120


class CellSize(NamedTuple):
    """Pixels of a cell along the columns and the rows."""

    rows: int
    columns: int

    @classmethod
    def for_image(cls, shape: tuple[int, int]) -> CellSize:
        """4 x 8 for 640 x 480, more for larger images, 1 x 2 for small ones."""
        rows = max(shape[0] // _ROWS, 1)
        return cls(rows, 2 * rows)

    def enlarged(self, cells: NDArray, shape: tuple[int, int]) -> NDArray:
        """Values of cells (rows, columns) for all pixels (H, W)."""
        wide = cells.repeat(self.rows, axis=0).repeat(self.columns, axis=1)
        return wide[: shape[0], : shape[1]]


class Cells(NamedTuple):
    """Means of the pixels of cells, (rows, columns).

    `ray` (3, ...) and `inverse` (...) range, 1/m, of the measured pixels, 0 where less than half
    of them are; `place` (3, ...) on `axes` (3, 3), height above the sensor along up and position
    along two horizontal directions, metres, NaN where not measured. `error` is the standard
    deviation of the height of a pixel, metres: by the sensor model, or by how much neighbouring
    pixels differ where that is more, as it is on grass and gravel. `variance` is that of the mean
    height, 0 where not measured and where pixels are of two surfaces: they differ by more than by
    noise.
    """

    ray: NDArray[np.float32]
    inverse: NDArray[np.float32]
    place: NDArray[np.float32]
    error: NDArray[np.float32]
    variance: NDArray[np.float64]
    size: CellSize
    axes: NDArray[np.float64]


def axes_of(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) up and two horizontal directions, the first along the optical axis if it can be."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([0.0, -1.0, 0.0])
    ahead = axis - (axis @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.array([up, ahead, np.cross(up, ahead)])


def cells_of(image: RangeImage, up: NDArray[np.float64], sensor: SensorModel) -> Cells:
    """Cells of an image; `up` (3,) is a unit vector in its frame."""
    size, axes = CellSize.for_image(image.shape), axes_of(up)
    shape = -(-image.shape[0] // size.rows), -(-image.shape[1] // size.columns)
    values = np.empty((6, *shape), np.float32)
    ray, inverse, scatter = values[:3], values[3], values[4:]
    means = ray, inverse, scatter
    run_rows(_means, shape[0], image.inverse, image.rays, image.pinhole, size, *means)
    with np.errstate(divide='ignore', invalid='ignore'):
        place = np.tensordot(axes.astype(np.float32), ray, 1) / inverse
        place[:, inverse == 0] = np.nan
        # The median: a cell on a jump edge scatters by more than noise.
        variance = np.maximum(random_variance(sensor, inverse**2), cv2.medianBlur(scatter[0], 5))
        error = np.where(inverse > 0, np.abs(place[0]) / inverse * np.sqrt(variance), 0)
    whole = (inverse > 0) & (scatter <= OUTLIER * variance).all(axis=0)
    share = sensor.white / (size.rows * size.columns) + 1 - sensor.white
    of_mean = np.where(whole, error.astype(np.float64) ** 2 * share + 1e-8, 0.0)
    return Cells(ray, inverse, place, error.astype(np.float32), of_mean, size, axes)


@njit(cache=True, nogil=True, error_model='numpy')
def _means(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    size: CellSize,
    ray: NDArray[np.float32],
    mean: NDArray[np.float32],
    scatter: NDArray[np.float32],
) -> None:
    """Of rows first...after of cells: mean ray, mean inverse range, and the scatter of that.

    Half the mean square of successive differences (von Neumann), along the rows, is the variance
    of the noise wherever the surface changes little from pixel to pixel. Down the columns, where
    ground recedes, it is that of differences about their mean.
    """
    height, width = inverse.shape
    for i in range(first, after):
        for c in range(mean.shape[1]):
            x = y = z = total = squares = fall = falls = np.float32(0)
            count = pairs = below = 0
            for v in range(i * size.rows, min((i + 1) * size.rows, height)):
                before = np.float32(0)
                for j in range(c * size.columns, min((c + 1) * size.columns, width)):
                    value = inverse[v, j]
                    if value > 0:
                        a, b, d = ray_of(rays, pinhole, v, j)
                        x, y, z = x + a, y + b, z + d
                        total += value
                        count += 1
                        if before > 0:
                            squares += (value - before) * (value - before)
                            pairs += 1
                    before = value
                    if v > i * size.rows and value > 0 and inverse[v - 1, j] > 0:
                        step = value - inverse[v - 1, j]
                        fall, falls, below = fall + step, falls + step * step, below + 1
            enough = 2 * count >= size.rows * size.columns
            ray[0, i, c], ray[1, i, c], ray[2, i, c] = x / count, y / count, z / count
            mean[i, c] = total / count if enough else np.float32(0)
            scatter[0, i, c] = squares / (2 * pairs) if pairs > 0 else np.float32(0)
            falls -= fall * fall / max(below, 1)
            scatter[1, i, c] = falls / (2 * max(below - 1, 1))
