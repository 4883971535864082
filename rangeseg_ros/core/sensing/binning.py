"""Bins: squares of pixels whose mean is one measurement.

Planes are smooth, so that they are found in bins; pixels are looked at where borders are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.enlargement import Cells, camera_of_cells
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.significance import chi2_quantile, quantile

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
    shape is the largest difference in each, 1/m. The `area` is that of a bin at inverse range
    1, m^2.
    """

    side: int
    pixels: RangeImage
    means: RangeImage
    spread: Singles
    area: float

    @classmethod
    def of(cls, image: RangeImage, side: int) -> Bins:
        """Those of an image; of one pixel each, they are the image."""
        area = side**2 * image.pixel_area
        if side == 1:
            return cls(1, image, image, np.zeros(image.shape, np.float32), area)
        inverse, spread = np.empty((2, *(-(-n // side) for n in image.shape)), np.float32)
        _average(image.inverse, side, inverse, spread)
        means = replace(image, inverse=inverse)
        if image.camera:
            camera = camera_of_cells(Cells(side, 0, 0), image.camera)
            means = replace(means, rays=camera.rays, camera=camera)
        else:
            known = [each > 0 for each in _places(image.inverse, side)]
            xyz = [_means(_places(image.rays[..., k], side), known) for k in range(3)]
            means = replace(means, rays=np.stack(xyz, axis=2))
        if image.body is not None:
            means = replace(means, body=np.any(_places(image.body, side), axis=0))
        return cls(side, image, means, spread, area)

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
        new = quantile((a - b - c + d) ** 2 / expected, 0.5) / (4 * _MEDIAN)
        return float(1 + (1 - 1 / side**2) * new)

    def of_one_surface(self, steps: Singles) -> RangeImage:
        """Means of the measurements near each bin's median: a jump mixes no two surfaces.

        `steps` are the smallest jumps in blocks of 4 x 4 bins, 1/m.
        """
        slope, inverse = np.float32(_STEEPEST * self.area**0.5), self.means.inverse.copy()
        rays, cloud = self.means.rays, self.means.camera is None
        # Rays of a camera are those of the middles of bins.
        means = rays.copy() if cloud else np.zeros((0, 0, 3), np.float32)
        given = self.pixels.inverse, self.pixels.rays, self.side, self.spread, steps, slope
        map_halves(_average_near_median, len(inverse), *given, inverse, means)
        return replace(self.means, inverse=inverse, rays=means if cloud else rays)


@njit(cache=True, nogil=True)
def _average(pixels: Singles, side: int, means: Singles, spread: Singles) -> None:
    """Fill in the mean of what was measured in each bin, and the largest difference there."""
    rows, columns = means.shape
    total, count = np.empty(columns), np.empty(columns, np.float32)
    most, least = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for i in range(rows):
        total[:], count[:], most[:], least[:] = 0, 0, 0, np.inf
        # Along a row, the compiler takes many bins at a time.
        for u in range(i * side, min((i + 1) * side, len(pixels))):
            for v in range(side):
                line = pixels[u, v::side]
                for j in range(len(line)):
                    y = line[j]
                    total[j] += y
                    count[j] += y > 0
                    most[j] = max(most[j], y)
                    least[j] = min(least[j], y if y > 0 else np.float32(np.inf))
        for j in range(columns):
            means[i, j] = total[j] / max(count[j], 1)
            spread[i, j] = max(most[j] - least[j], np.float32(0))


@njit(cache=True, nogil=True)
def _average_near_median(
    first: int,
    after: int,
    pixels: Singles,
    rays: Singles,
    side: int,
    spread: Singles,
    steps: Singles,
    slope: np.float32,
    means: Singles,
    mean_rays: Singles,
) -> None:
    """Average the measurements of bins in rows first...after anew, near their median alone.

    Of those whose `spread` is wide.
    """
    values, total = np.empty(side * side, np.float32), np.empty(4)
    for i in range(first, after):
        least = steps[i // BLOCK].min()
        for j in range(means.shape[1]):
            if spread[i, j] < least:  # as of most
                continue
            limit = steps[i // BLOCK, j // BLOCK] + slope * means[i, j]
            if means[i, j] == 0 or spread[i, j] < limit:
                continue
            count, kept, middle = 0, 0, np.float32(0)
            bottom, end = min((i + 1) * side, len(pixels)), min((j + 1) * side, pixels.shape[1])
            for u in range(i * side, bottom):
                for v in range(j * side, end):
                    values[count] = pixels[u, v]
                    count += pixels[u, v] > 0
            for a in range(count):
                below = ties = 0
                for b in range(count):
                    below, ties = below + (values[b] < values[a]), ties + (values[b] == values[a])
                # Of two surfaces that are as large, the nearer one.
                if below <= count // 2 < below + ties:
                    middle = values[a]
            total[:] = 0
            for u in range(i * side, bottom):
                for v in range(j * side, end):
                    if pixels[u, v] > 0 and abs(pixels[u, v] - middle) <= limit:
                        kept += 1
                        total[3] += pixels[u, v]
                        for k in range(3):
                            total[k] += rays[u, v, k]
            means[i, j] = total[3] / kept
            if len(mean_rays) > 0:
                for k in range(3):
                    mean_rays[i, j, k] = total[k] / kept


def _places(pixels: NDArray, side: int) -> list[NDArray]:
    """The first pixel of every bin, the second, ...: views (rows, columns) of pixels (H, W)."""
    margin = [(0, -length % side) for length in pixels.shape]
    pixels = np.pad(pixels, margin) if np.any(margin) else pixels
    return [pixels[i::side, j::side] for i, j in np.ndindex(side, side)]


def _means(values: list[NDArray], kept: list[NDArray]) -> Singles:
    """Means (...) of those of K values (...) each that are kept; 0 of none."""
    total = np.zeros(values[0].shape)
    for each, some in zip(values, kept, strict=True):
        total += np.where(some, each, 0)
    return (total / np.maximum(np.sum(kept, axis=0), 1)).astype(np.float32)


# Least budget at which the sides of bins are n times as long (docs/benchmark.md).
_SHARES = {1: 1.0, 2: 0.55, 4: 0.35}

BUDGETS = tuple(_SHARES.values())
"""The distinct budgets, falling."""


def widening(budget: float) -> int:
    """By how much bins are wider, for a share `budget` of the full work, 0...1."""
    return next((step for step, share in _SHARES.items() if budget >= share), max(_SHARES))


def bin_side(shape: tuple[int, int], work_budget: float) -> int:
    """Pixels along the side of the bins of an image (H, W): 2 of VGA, more with less work."""
    return widening(work_budget) * max(round(float(np.sqrt(shape[0] * shape[1] / _BINS))), 1)
