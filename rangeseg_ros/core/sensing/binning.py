"""Bins: squares of pixels whose mean is one measurement.

Planes are smooth, so that they are found in bins; pixels are looked at where borders are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.runtime.work import step_within
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.enlargement import Cells
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.significance import chi2_quantile

# Pixels of an image that needs no bins.
_BINS = VGA / 4
# Bins that tell how much of the noise is new in every pixel, about: see `fitting.noise`.
_ENOUGH = 2400
# Median of chi-squared of one degree of freedom.
_MEDIAN = chi2_quantile(1, 0.5)
# Rows and columns of 2 x 2 pixels.
_SQUARE = (0, 0), (0, 1), (1, 0), (1, 1)
# Slope of a surface that is seen at 5 degrees: what is steeper is a jump.
_STEEPEST = 1 / np.tan(np.radians(5))


class Bins(NamedTuple):
    """Squares of `side` x `side` pixels of an image (H, W), and a pixel for each in `means`.

    That is the mean of what was measured, (ceil(H / side), ceil(W / side)); `spread` of the same
    shape is the largest difference in each, 1/m. The `area` is that of a bin, see `pixel_area`.
    """

    side: int
    pixels: RangeImage
    means: RangeImage
    spread: NDArray[np.float32]
    area: float

    @classmethod
    def of(cls, image: RangeImage, side: int) -> Bins:
        """Those of an image; of one pixel each, they are the image."""
        area = side**2 * pixel_area(image.rays)
        if side == 1:
            return cls(1, image, image, np.zeros(image.shape, np.float32), area)
        rows, columns = (-(-length // side) for length in image.shape)
        inverse, spread = np.empty((2, rows, columns), np.float32)
        run_rows(_mean, rows, image.inverse, side, inverse, spread)
        camera = Cells(side, 0, 0).camera(image.camera) if image.camera else None
        rays = camera.rays if camera else np.empty((rows, columns, 3), np.float32)
        body = image.body
        if body is not None:
            for axis, length in enumerate(image.shape):
                body = np.logical_or.reduceat(body, np.arange(0, length, side), axis)
        means = replace(image, rays=rays, inverse=inverse, camera=camera, body=body)
        bins = cls(side, image, means, spread, area)
        if camera is None:
            endless = np.full_like(spread, np.inf)
            bins = bins._replace(means=bins._replace(spread=endless)._averaged(endless))
        return bins

    def noise_of_pixels(self, sensor: SensorModel) -> float:
        """Random variance of a pixel over that of its bin, which `sensor` tells.

        The twisted difference of 2 x 2 pixels, (a - b - c + d) / 2, is zero on planes and has the
        variance of what is new in every pixel, of which the mean of n pixels has an nth.
        """
        side, inverse = self.side, self.pixels.inverse
        if side == 1:
            return 1.0
        rows, columns = len(inverse) // side, inverse.shape[1] // side
        step = max(int(np.sqrt(rows * columns / _ENOUGH)), 1) * side
        corner = [inverse[i : rows * side : step, j : columns * side : step] for i, j in _SQUARE]
        four = np.stack(corner).astype(np.float64)
        a, b, c, d = four[:, (four > 0).all(axis=0)]
        if not len(a):
            return 1.0
        expected = random_variance(sensor, ((a + b + c + d) / 4) ** 2)
        new = np.median((a - b - c + d) ** 2 / expected) / (4 * _MEDIAN)
        return float(1 + (1 - 1 / side**2) * new)

    def of_one_surface(self, steps: NDArray[np.float32]) -> RangeImage:
        """Means of the measurements near each bin's median: a jump mixes no two surfaces.

        `steps` are the smallest jumps in blocks of 4 x 4 bins, 1/m.
        """
        return self._averaged(steps)

    def _averaged(self, steps: NDArray[np.float32]) -> RangeImage:
        inverse = self.means.inverse.copy()
        # A camera has the rays of its bins.
        rays = (self.means.rays if self.means.camera is None else self.means.rays[:0]).copy()
        slope = np.float32(_STEEPEST * self.area**0.5)
        given = self.pixels.inverse, self.pixels.rays, self.side, self.spread, steps, slope
        run_rows(_average, len(inverse), *given, inverse, rays)
        # Like those of cameras, or every kernel that reads them is compiled twice.
        rays.flags.writeable = False
        return replace(self.means, inverse=inverse, rays=rays if rays.size else self.means.rays)


def bin_side(shape: tuple[int, int], work_budget: float) -> int:
    """Pixels along the side of the bins of an image (H, W): 2 of VGA, more with less work."""
    return step_within(work_budget) * max(round(float(np.sqrt(shape[0] * shape[1] / _BINS))), 1)


def pixel_area(rays: NDArray[np.float32]) -> float:
    """Median area of a pixel at inverse range 1 of an image with `rays` (H, W, 3), m^2."""
    step = max(BLOCK, *(side // 16 for side in rays.shape[:2]))  # a few hundred pixels tell it
    here = rays[::step, ::step].astype(np.float64)
    across, down = np.diff(here, axis=1)[:-1], np.diff(here, axis=0)[:, :-1]
    area = np.linalg.norm(np.cross(across, down), axis=2) / step**2
    return float(np.median(area)) if area.size else 0.0


@njit(cache=True, nogil=True)
def _mean(
    first: int,
    after: int,
    pixels: NDArray[np.float32],
    side: int,
    inverse: NDArray[np.float32],
    spread: NDArray[np.float32],
) -> None:
    """Fill in means and spreads of all that was measured in some rows of bins."""
    for i in range(first, after):
        for j in range(inverse.shape[1]):
            total, count, least, most = np.float32(0), 0, np.float32(np.inf), np.float32(0)
            for u in range(i * side, min((i + 1) * side, pixels.shape[0])):
                for v in range(j * side, min((j + 1) * side, pixels.shape[1])):
                    y = pixels[u, v]
                    total, count, most = total + y, count + (y > 0), max(most, y)
                    least = min(least, y if y > 0 else least)
            inverse[i, j] = total / np.float32(max(count, 1))
            spread[i, j] = most - least if count > 0 else np.float32(0)


@njit(cache=True, nogil=True)
def _average(
    first: int,
    after: int,
    pixels: NDArray[np.float32],
    rays: NDArray[np.float32],
    side: int,
    spread: NDArray[np.float32],
    steps: NDArray[np.float32],
    slope: np.float32,
    inverse: NDArray[np.float32],
    means: NDArray[np.float32],
) -> None:
    """Average inverse ranges within a step of the median in some rows of bins that spread farther.

    And rays where there is room for them.
    """
    values = np.empty(side * side, np.float32)
    for i in range(first, after):
        for j in range(inverse.shape[1]):
            step = steps[i // BLOCK, j // BLOCK] + slope * inverse[i, j]
            if spread[i, j] < step:
                continue
            count = 0
            for u in range(i * side, min((i + 1) * side, pixels.shape[0])):
                for v in range(j * side, min((j + 1) * side, pixels.shape[1])):
                    if pixels[u, v] > 0:
                        values[count] = pixels[u, v]
                        count += 1
            if count == 0:
                continue
            # Of two surfaces that are as large, the nearer one.
            middle = np.sort(values[:count])[count // 2] if step < np.inf else values[0]
            total, used, x, y, z = 0.0, 0, 0.0, 0.0, 0.0
            for u in range(i * side, min((i + 1) * side, pixels.shape[0])):
                for v in range(j * side, min((j + 1) * side, pixels.shape[1])):
                    if pixels[u, v] > 0 and abs(pixels[u, v] - middle) <= step:
                        total, used = total + pixels[u, v], used + 1
                        x, y, z = x + rays[u, v, 0], y + rays[u, v, 1], z + rays[u, v, 2]
            inverse[i, j] = total / used
            if len(means) > 0:
                means[i, j, 0], means[i, j, 1], means[i, j, 2] = x / used, y / used, z / used
