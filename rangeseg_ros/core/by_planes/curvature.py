"""Sums that tell a bent region from one that the sensor's distortion bends."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.posterior import Residuals, plane_probabilities
from rangeseg_ros.core.by_planes.quadratics import add_terms
from rangeseg_ros.core.fitting.first_planes import FirstPlanes
from rangeseg_ros.core.fitting.interior import find_loose
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.marks import no_marks
from rangeseg_ros.core.sensing.moments import CHI2, COUNT, RATIO, squares_left
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import ray_of
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.significance import OUTLIER


def probabilities(
    regions: NDArray[np.uint16],
    first: FirstPlanes,
    image: RangeImage,
    blocks: Blocks,
    sensor: SensorModel,
    prior: float,
) -> NDArray[np.float64]:
    """Probability of each region to be a plane, by the second-order part of its residuals.

    What is asked for is smooth: of a block of 4 x 4 pixels that a region fills its sums tell it,
    elsewhere the pixels that `first` looks at.

    Parameters
    ----------
    regions : (H, W) uint16
        0...M, 0 for no region.
    first : FirstPlanes
        Of the regions.
    image : RangeImage
        (H, W).
    blocks : Blocks
        Of the image.
    sensor : SensorModel
    prior : float
        Share of planes among regions.

    Returns
    -------
    (M + 1,) float64
        0 for region 0.
    """
    filled, moments, theta, stride = first
    covered = np.maximum(moments[:, COUNT], 1)
    ratio = moments[:, RATIO] / covered
    # A residual is the region's up to noise and twice the distortion.
    limit = OUTLIER**2 * (1 + 4 * ratio)
    pixels = regions, filled, image.inverse, image.rays, image.pinhole
    planes = blocks, sensor, theta, limit, stride
    parts = map_halves(_normal_equations, len(filled), *pixels, *planes)
    powers, right, (square, area, scale) = (a + b for a, b in zip(*parts, strict=True))
    residuals = Residuals(powers, right, square, area, scale, covered, ratio)
    around, alike = float(max(sensor.distortion_pixels, 1)), float(sensor.correlated)
    return plane_probabilities(residuals, around, alike, prior)


@njit(cache=True, nogil=True)
def _normal_equations(
    first: int,
    after: int,
    regions: NDArray[np.uint16],
    filled: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    blocks: Blocks,
    sensor: SensorModel,
    theta: NDArray[np.float64],
    limit: NDArray[np.float64],
    stride: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Normal equations of a quadratic in the pixel coordinates, from some rows of blocks.

    The first array (M + 1, 15) has the sums of x^0 ... x^4, of x^0 y ... x^3 y and so on to y^4,
    which the matrices consist of. What is fitted are residuals in standard deviations of the noise
    of a pixel, of a block their mean as often as it has pixels; those of a mean square beyond
    `limit` are left out. The third array (3, M + 1) has the sum of their squares, the area of each
    region in square metres, and the sum over its pixels of the standard deviation in metres, both
    on and across its plane: neither depends on how obliquely it is seen.
    """
    height, width = regions.shape
    count = len(theta)
    normal, right, total = np.zeros((count, 15)), np.zeros((count, 6)), np.zeros((3, count))
    # |theta|, 0 where there is no plane.
    slope = np.sqrt(theta[:, 0] ** 2 + theta[:, 1] ** 2 + theta[:, 2] ** 2)
    marks = no_marks(width)
    places = np.empty(len(marks), np.intp)
    for bi in range(first, after):
        # Of blocks of a region side by side, sums over powers of x: y is the same.
        run, middle = 0, bi * BLOCK + BLOCK // 2
        s0 = s1 = s2 = s3 = s4 = t0 = t1 = t2 = squares = areas = deviations = 0.0
        for bj in range(filled.shape[1] + 1):
            label = int(filled[bi, bj]) if bj < filled.shape[1] else 0
            if label != run:
                y, powers = (2 * middle - 1 - height) / width, (s0, s1, s2, s3, s4)
                add_terms(normal[run], right[run], y, powers, (t0, t1, t2))
                _add_size(total, run, squares, areas, deviations)
                s0 = s1 = s2 = s3 = s4 = t0 = t1 = t2 = squares = areas = deviations = 0.0
                run = label
            if bj == filled.shape[1]:
                continue
            squared = blocks.squared[bi, bj]
            # Of too few pixels there is no plane.
            if label == 0 or squared == 0 or slope[label] == 0:
                continue
            moments, variance = blocks.moments[bi, bj], random_variance(sensor, squared)
            pixels, left = moments[COUNT], squares_left(moments, theta[label])
            square = max(left, 0.0) / (variance * pixels)
            if square > limit[label]:
                continue
            # The mean of residuals times the plane's inverse range, which hardly varies.
            along = 0.0
            for m in range(3):
                along += theta[label, m] * moments[6 + m]
            level = max(left - moments[CHI2] + 2 * along, 1e-300)
            residual = (along - level) / np.sqrt(level * pixels * variance)
            j = bj * BLOCK + BLOCK // 2
            x = (2 * j - 1 - width) / width
            a, b = pixels * x * x, pixels * residual
            s0, s1, s2 = s0 + pixels, s1 + pixels * x, s2 + a
            s3, s4 = s3 + a * x, s4 + a * x * x
            t0, t1, t2 = t0 + b, t1 + b * x, t2 + b * x * x
            near = 1 / np.sqrt(squared)
            squares += pixels * square
            areas += pixels * _area(middle, j, rays, pinhole) * near**3
            deviations += pixels * np.sqrt(variance) * near
        for i in range(bi * BLOCK, min((bi + 1) * BLOCK, height), stride):
            found = find_loose(regions[i], filled[bi], marks, places)
            y, pixels = (2 * i - height) / width, float(stride**2)
            for place in places[:found]:
                j = int(place)
                label, value = int(regions[i, j]), float(inverse[i, j])
                if value == 0 or slope[label] == 0 or j % stride > 0:
                    continue
                squared = value * value
                variance = random_variance(sensor, squared)
                residual, ray = value, ray_of(rays, pinhole, i, j)
                for m in range(3):
                    residual -= theta[label, m] * ray[m]
                deviation, near = np.sqrt(variance), 1 / value
                residual /= deviation
                square = residual * residual
                if square <= limit[label]:
                    x = (2 * j - width) / width
                    a, b = pixels * x * x, pixels * residual
                    powers = pixels, pixels * x, a, a * x, a * x * x
                    add_terms(normal[label], right[label], y, powers, (b, b * x, b * x * x))
                    area = pixels * _area(i, j, rays, pinhole) * near**3
                    _add_size(total, label, pixels * square, area, pixels * deviation * near)
    for label in range(count):
        if slope[label] > 0:
            # An error of the inverse leaves the plane by distance / inverse times as much.
            total[1, label] *= slope[label]
            total[2, label] /= slope[label]
    return normal, right, total


@njit(cache=True, inline='always')
def _add_size(
    total: NDArray[np.float64], label: int, square: float, area: float, deviation: float
) -> None:
    """Add to the third result of `_normal_equations`."""
    total[0, label] += square
    total[1, label] += area
    total[2, label] += deviation


@njit(cache=True, inline='always')
def _area(i: int, j: int, rays: NDArray[np.float32], pinhole: bool) -> float:
    """Area over |theta| of a pixel on its plane, times its inverse range^3; 0 if not known."""
    if i == 0 or j == 0:
        return 0.0
    across = down = length = left = above = 0.0
    own = ray_of(rays, pinhole, i, j)
    before, over = ray_of(rays, pinhole, i, j - 1), ray_of(rays, pinhole, i - 1, j)
    for k in range(3):
        across += (own[k] - before[k]) ** 2
        down += (own[k] - over[k]) ** 2
        length += own[k] ** 2
        left += before[k] ** 2
        above += over[k] ** 2
    # Rays of a cloud are 0 where nothing was measured.
    if min(length, left, above) == 0:
        return 0.0
    # Seen face on it is smaller by the cosine, distance inverse / length.
    return np.sqrt(across * down * length)
