"""Which regions bend more than the sensor's distortion bends a plane."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.moments import COUNT, RATIO
from rangeseg_ros.core.refinement import Models, Problem, region_moments
from rangeseg_ros.core.sensor import SensorModel

# The distortion of real Kinects over planes of A pixels, measured on hand-annotated frames, has
# 0.6 of its overall standard deviation at 10^4 pixels and grows as A^0.39. Real planes stay
# within two and a half times that.
_SHARE, _PIXELS, _EXPONENT = 1.5**2, 1e4, 0.78
# A bend of less than 2 % of its width, root mean square, is a plane to most who ask: a bulging
# box. A sphere cut to pieces of a third of its radius bends by 3 %.
_FLATNESS = 0.02
# Nine agreeing pixels count as one; the chi-squared of three terms of curvature stays below four
# times its mean.
_NOISE = 9.0 * 3.0 * 4.0
_STRIDE = 2
# Standard deviations, of noise and twice the distortion, to which a residual is the region's.
_INLIER = 4.0


def curved(
    problem: Problem, regions: NDArray[np.uint16], sensor: SensorModel
) -> NDArray[np.bool_]:
    """Test the second-order part of each region's residuals.

    Parameters
    ----------
    problem : Problem
    regions : (H, W) uint16
        0...M, 0 for no region.
    sensor : SensorModel

    Returns
    -------
    (M + 1,) bool
        Never true for 0.
    """
    count = int(regions.max(initial=0)) + 1
    # Every other row and column will do: what is asked for is smooth.
    sparse = (slice(None, None, _STRIDE), slice(None, None, _STRIDE))
    problem = problem.crop(*sparse)
    regions = regions[sparse]
    moments = region_moments(problem, regions, count, sensor)
    models = Models.of(moments)
    ratio = moments[:, RATIO] / np.maximum(moments[:, COUNT], 1)
    limit = _INLIER * np.sqrt(1 + 4 * ratio)
    normal, right, square, area, scale = _normal_equations(
        regions, problem.inverse, problem.rays, problem.weight, models.theta, limit
    )
    pixels = normal[:, 0, 0]
    size = np.maximum(pixels * _STRIDE**2, 1)
    ridge = 1e-9 * np.maximum(pixels, 1)[:, None, None] * np.eye(6)
    solution = np.linalg.solve(normal + ridge, right[..., None])[..., 0]
    bending = np.einsum('ki,kij,kj->k', solution, normal, solution) / np.maximum(pixels, 1)
    distortion = _SHARE * ratio * (size / _PIXELS) ** _EXPONENT
    # Noise as the region itself shows it: at a grazing angle it is more than that of the sensor.
    rest = square - (solution * right).sum(axis=1)
    noise = np.maximum(rest / np.maximum(pixels, 1), 1)
    visible = bending > distortion + _NOISE * noise / size
    result = visible & (bending * (scale / np.maximum(pixels, 1)) ** 2 > _FLATNESS**2 * area)
    result[0] = False
    return result


@njit(cache=True)
def _normal_equations(
    regions: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    weight: NDArray[np.float32],
    theta: NDArray[np.float64],
    limit: NDArray[np.float64],
) -> tuple[
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]:
    """Normal equations of a quadratic in the pixel coordinates fitted to each region.

    What is fitted are the residuals in standard deviations of the noise, those beyond `limit`
    left out. Also returns the sum of their squares, the area in square metres of each region seen
    face on, and the sum over its pixels of the standard deviation in metres.
    """
    height, width = regions.shape
    count = len(theta)
    normal, right = np.zeros((count, 6, 6)), np.zeros((count, 6))
    total, area, scale = np.zeros(count), np.zeros(count), np.zeros(count)
    basis = np.ones(6)
    for i in range(height):
        y = 2 * (i - height / 2) / width
        for j in range(width):
            label = regions[i, j]
            if label == 0:
                continue
            plane, ray = theta[label], rays[i, j]
            value = inverse[i, j] - (plane[0] * ray[0] + plane[1] * ray[1] + plane[2] * ray[2])
            root = np.sqrt(weight[i, j])
            value *= root
            if abs(value) > limit[label]:
                continue
            total[label] += value * value
            square = inverse[i, j] ** 2
            scale[label] += 1 / (root * square)
            if i > 0 and j > 0 and inverse[i - 1, j] > 0 and inverse[i, j - 1] > 0:
                across, along = 0.0, 0.0
                for k in range(3):
                    across += (ray[k] - rays[i, j - 1, k]) ** 2
                    along += (ray[k] - rays[i - 1, j, k]) ** 2
                area[label] += np.sqrt(across * along) / square
            x = 2 * j / width - 1
            basis[1], basis[2] = x, y
            basis[3], basis[4], basis[5] = x * x, x * y, y * y
            for a in range(6):
                right[label, a] += basis[a] * value
                for b in range(a, 6):
                    normal[label, a, b] += basis[a] * basis[b]
    for a in range(6):
        for b in range(a):
            normal[:, a, b] = normal[:, b, a]
    return normal, right, total, area, scale
