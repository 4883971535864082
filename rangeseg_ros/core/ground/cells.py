"""Cells of a few pixels: what the ground is looked for in, and continued in.

A cell is the mean of its pixels, which for a plane is a point of the plane: theta . ray = inverse
is linear. Cells are wider than high, because the ground recedes along the columns.

The ground continued is a plane for every cell. Each block's plane is fitted to the ground in a
window around it, with that of the whole image as its prior, whose own is the plane under the robot
(ridge regressions): where the ground is seen, it follows undulation and distortion; where it is
not, it goes on straight.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Mask, Singles
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.moments import SIZE, SYMMETRIC, fit_all, ray_of
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.significance import OUTLIER

UNKNOWN, GROUND, OBSTACLE, DROP = range(4)
"""Values of `Segmentation.terrain`, what a measured point is to a robot that drives: not measured
or not known, ground, in the way, below.
"""
# Rows of an image whose cells are 1 x 2 pixels.
_ROWS = 120
# Cells of a block of the ground continued, which is about square.
_DOWN, _RIGHT = 4, 2
# The prior counts as so much of a window full of ground: it decides where little of it is seen.
_PRIOR = 1 / 16


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


class GroundCells(NamedTuple):
    """Means of the pixels of cells, (rows, columns), with the nearest row first.

    `ray` (3, ...) and `inverse` (...) range, 1/m, of the measured pixels, 0 where less than half
    of them are; `place` (3, ...) on `axes` (3, 3), height above the sensor along up and position
    along two horizontal directions, metres, NaN where not measured. `error` is the standard
    deviation of the height of a pixel, metres: by the sensor model, or by how much neighbouring
    pixels differ where that is more, as it is on grass and gravel. `variance` is that of the mean
    height, 0 where not measured and where pixels are of two surfaces: they differ by more than by
    noise. `order` of the rows is that of the image.
    """

    ray: Singles
    inverse: Singles
    place: Singles
    error: Singles
    variance: Floats
    size: CellSize
    axes: Floats
    order: slice


def axes_of(up: Floats) -> Floats:
    """(3, 3) up and two horizontal directions, the first along the optical axis if it can be."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([0.0, -1.0, 0.0])
    ahead = axis - (axis @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.array([up, ahead, np.cross(up, ahead)])


def cells_of(image: RangeImage, up: Floats, sensor: SensorModel, turned: bool) -> GroundCells:
    """Cells of an image; `up` (3,) is a unit vector in its frame, `turned` where it is down."""
    size, axes = CellSize.for_image(image.shape), axes_of(up)
    shape = -(-image.shape[0] // size.rows), -(-image.shape[1] // size.columns)
    values = np.empty((6, *shape), np.float32)
    map_halves(_means, shape[0], image.inverse, image.rays, image.pinhole, size, values)
    order = slice(None, None, 1 if turned else -1)
    values = np.ascontiguousarray(values[:, order])
    ray, inverse, scatter = values[:3], values[3], values[4:]
    with np.errstate(divide='ignore', invalid='ignore'):
        place = np.tensordot(axes.astype(np.float32), ray, 1) / inverse
        place[:, inverse == 0] = np.nan
        # The median: a cell on a jump edge scatters by more than noise.
        variance = np.maximum(random_variance(sensor, inverse**2), cv2.medianBlur(scatter[0], 5))
        error = np.where(inverse > 0, np.abs(place[0]) / inverse * np.sqrt(variance), 0)
        rounding = np.finfo(np.float32).eps / inverse.astype(np.float64)
    whole = (inverse > 0) & (scatter <= OUTLIER * variance).all(axis=0)
    share = sensor.white / (size.rows * size.columns) + 1 - sensor.white
    # No height is known better than it is computed, far away least of all.
    of_mean = np.where(whole, error.astype(np.float64) ** 2 * share + 1e-8 + rounding**2, 0.0)
    return GroundCells(ray, inverse, place, error.astype(np.float32), of_mean, size, axes, order)


@njit(cache=True, nogil=True, error_model='numpy')
def _means(
    first: int,
    after: int,
    inverse: Singles,
    rays: Singles,
    pinhole: bool,
    size: CellSize,
    values: Singles,
) -> None:
    """Of rows first...after of cells: mean ray, mean inverse range, and the scatter of that.

    Half the mean square of successive differences (von Neumann), along the rows, is the variance
    of the noise wherever the surface changes little from pixel to pixel. Down the columns, where
    ground recedes, it is that of differences about their mean.
    """
    (height, width), ray, mean, scatter = inverse.shape, values[:3], values[3], values[4:]
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


class GroundField(NamedTuple):
    """The ground continued, by planes of cells: theta (3, rows, columns) . ray = inverse range."""

    theta: Singles
    size: CellSize
    up: Floats

    def turned(self) -> GroundField:
        """Of the image with rows and columns exchanged."""
        return GroundField(self.theta.transpose(0, 2, 1), CellSize(*self.size[::-1]), self.up)

    def heights(self, cells: GroundCells) -> Singles:
        """Heights (rows, columns) of cells above the ground, metres; NaN where not measured."""
        along = (self.theta * cells.ray).sum(axis=0)
        with np.errstate(divide='ignore', invalid='ignore'):
            below = cells.inverse * np.tensordot(self.up.astype(np.float32), self.theta, 1)
            heights: Singles = (along - cells.inverse) / below
        heights[cells.inverse == 0] = np.nan
        return heights


def ground_field(cells: GroundCells, ground: Mask, base: Floats) -> GroundField:
    """The ground continued, from its cells (rows, columns) and the plane (3,) under the robot."""
    sums = _sums(cells.ray, cells.inverse, ground)
    whole = _fitted(sums.sum(axis=(1, 2), keepdims=True), base)
    theta = _fitted(sums, whole[0, 0])
    rows, columns = ground.shape
    large = (theta.shape[1] * _RIGHT, theta.shape[0] * _DOWN)
    spread = cv2.resize(theta, large, interpolation=cv2.INTER_LINEAR)[:rows, :columns]
    planes = np.ascontiguousarray(spread.transpose(2, 0, 1), np.float32)
    return GroundField(planes, cells.size, cells.axes[0])


@njit(cache=True, nogil=True)
def _sums(ray: Singles, inverse: Singles, ground: Mask) -> Floats:
    """Sums (2, M, N, 9) over blocks, of the ground and of all that is measured.

    They are those of the regression: ray ray^T (xx, xy, xz, yy, yz, zz) and ray * inverse.
    """
    rows, columns = ground.shape
    sums = np.zeros((2, -(-rows // _DOWN), -(-columns // _RIGHT), 9))
    for i in range(rows):
        for c in range(columns):
            s = inverse[i, c]
            if s > 0:
                x, y, z = ray[0, i, c], ray[1, i, c], ray[2, i, c]
                entries = (x * x, x * y, x * z, y * y, y * z, z * z, x * s, y * s, z * s)
                for n in range(9):
                    sums[1, i // _DOWN, c // _RIGHT, n] += entries[n]
                    if ground[i, c]:
                        sums[0, i // _DOWN, c // _RIGHT, n] += entries[n]
    return sums


def _fitted(sums: Floats, prior: Floats) -> Floats:
    """Planes (M, N, 3) that fit the ground in windows of 3 x 3 blocks and all rays on the prior.

    That is the plane (3,) itself where there is no ground.
    """
    ground, seen = (cv2.blur(a, (3, 3), borderType=cv2.BORDER_CONSTANT) for a in sums)
    moments = np.zeros((*ground.shape[:2], SIZE))
    moments[..., :9] = ground
    moments[..., :6] += _PRIOR * seen[..., :6]
    moments[..., 6:9] += _PRIOR * (seen[..., SYMMETRIC] * prior).sum(axis=3)
    theta = fit_all(moments.reshape(-1, SIZE))[0].reshape(*ground.shape[:2], 3)
    known = theta.any(axis=2) & ground[..., [0, 3, 5]].any(axis=2)
    return np.where(known[..., None], theta, prior)


def classify(
    image: RangeImage, field: GroundField, bounds: Singles
) -> tuple[NDArray[np.uint8], Singles]:
    """Class, 0 where not measured, and height above the ground, metres, of every pixel (H, W).

    By `bounds` (3, rows, columns) of the cells, metres: up to the first off the ground a pixel is
    ground, below the second a drop, above the third an obstacle, and these count more than the
    first. Heights are NaN where not measured.
    """
    classes, heights = np.empty(image.shape, np.uint8), np.empty(image.shape, np.float32)
    rise = np.tensordot(field.up.astype(np.float32), field.theta, 1)
    pixels = image.inverse, image.rays, image.pinhole
    map_halves(_classify, len(rise), *pixels, field, rise, bounds, classes, heights)
    return classes, heights


@njit(cache=True, nogil=True, error_model='numpy')
def _classify(
    first: int,
    after: int,
    inverse: Singles,
    rays: Singles,
    pinhole: bool,
    field: GroundField,
    rise: Singles,
    bounds: Singles,
    classes: NDArray[np.uint8],
    heights: Singles,
) -> None:
    """Of rows first...after of cells."""
    (height, width), (theta, size, _) = inverse.shape, field
    for i in range(first, after):
        for v in range(i * size.rows, min((i + 1) * size.rows, height)):
            for c in range(rise.shape[1]):
                a, b, d, up = theta[0, i, c], theta[1, i, c], theta[2, i, c], rise[i, c]
                flat, lowest, highest = bounds[0, i, c], bounds[1, i, c], bounds[2, i, c]
                low, high = max(-flat, lowest), min(flat, highest)
                for j in range(c * size.columns, min((c + 1) * size.columns, width)):
                    x, y, z = ray_of(rays, pinhole, v, j)
                    s = inverse[v, j]
                    h = (a * x + b * y + d * z - s) / (s * up) if s > 0 else np.float32(np.nan)
                    heights[v, j] = h
                    # All of them are false where nothing was measured.
                    classes[v, j] = (
                        np.uint8((h >= low) & (h <= high)) * GROUND
                        + np.uint8(h > highest) * OBSTACLE
                        + np.uint8(h < lowest) * DROP
                    )
