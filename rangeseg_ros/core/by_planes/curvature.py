"""Which regions bend more than the sensor's distortion bends a plane."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.plane_energy import Problem, region_moments
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.moments import COUNT, RATIO, fit_all
from rangeseg_ros.core.sensing.sensor import SensorModel

# The distortion of real Kinects over planes of A pixels, measured on hand-annotated frames, has
# 0.6 of its overall standard deviation at 10^4 pixels and grows as A^0.39. Real planes stay
# within two and a half times that, and the distortion is measured to within a tenth.
_SHARE, _PIXELS, _EXPONENT = 1.7**2, 1e4, 0.78
# A bend of less than 0.7 % of its width, root mean square, is a plane to most who ask: a bulging
# box; of hand-annotated planes whose bend was to be seen, none bent by more than 0.5 %. A sphere
# cut to pieces of a third of its radius bends by 3 %, a cylinder cut to strips as wide as its
# radius and three times as high by 2 %.
_FLATNESS = 0.007
# Nine agreeing pixels count as one; the chi-squared of three terms of curvature stays below four
# times its mean.
_NOISE = 9.0 * 3.0 * 4.0
_STRIDE = 2
# Exponents of the six terms of a quadratic in the pixel coordinates x and y.
_X, _Y = (0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2)
# Standard deviations, of noise and twice the distortion, to which a residual is the region's.
_INLIER = 4.0


def find_curved(
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
    shape, regions = regions.shape, regions[sparse]
    inverse = problem.inverse.reshape(shape)[sparse]
    rays = problem.rays.reshape(*shape, 3)[sparse]
    weight = problem.weight.reshape(shape)[sparse]
    moments = region_moments(regions, count, inverse, rays, weight, sensor)
    theta, _ = fit_all(moments)
    ratio = moments[:, RATIO] / np.maximum(moments[:, COUNT], 1)
    limit = _INLIER * np.sqrt(1 + 4 * ratio)
    parts = map_halves(
        _normal_equations,
        len(regions),
        regions,
        inverse,
        rays,
        weight,
        theta,
        limit,
    )
    normal, right, square, area, scale = map(np.add, *parts)
    pixels = normal[:, 0, 0]
    size = np.maximum(pixels * _STRIDE**2, 1)
    # What the quadratic explains more than its constant and linear terms do.
    whole, flat = _explained(normal, right), _explained(normal[:, :3, :3], right[:, :3])
    bending = (whole - flat) / np.maximum(pixels, 1)
    distortion = _SHARE * ratio * (size / (problem.enlarged * _PIXELS)) ** _EXPONENT
    # Noise as the region itself shows it: at a grazing angle it is more than that of the sensor.
    noise = np.maximum((square - whole) / np.maximum(pixels, 1), 1)
    visible = bending > distortion + _NOISE * noise / size
    result = visible & (bending * (scale / np.maximum(pixels, 1)) ** 2 > _FLATNESS**2 * area)
    result[0] = False
    return result


def _explained(normal: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of squares (N,) that least-squares fits explain, of their normal equations."""
    terms = normal.shape[1]
    ridge = 1e-9 * np.maximum(normal[:, 0, 0], 1)[:, None, None] * np.eye(terms)
    solution = np.linalg.solve(normal + ridge, right[..., None])[..., 0]
    return (solution * right).sum(axis=1)


@njit(cache=True, nogil=True)
def _normal_equations(
    first: int,
    after: int,
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
    """Normal equations of a quadratic in the pixel coordinates fitted to some rows of each region.

    What is fitted are the residuals in standard deviations of the noise, those beyond `limit`
    left out. Also returns the sum of their squares, the area in square metres of each region, and
    the sum over its pixels of the standard deviation in metres, both on and across its plane:
    neither depends on how obliquely it is seen.
    """
    height, width = regions.shape
    count = len(theta)
    normal, right = np.zeros((count, 6, 6)), np.zeros((count, 6))
    total, area, scale = np.zeros(count), np.zeros(count), np.zeros(count)
    for i in range(first, after):
        y = 2 * (i - height / 2) / width
        j = 0
        while j < width:
            label = regions[i, j]
            plane = theta[label]
            slope = np.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
            # No region, or one of too few pixels for a plane.
            if slope == 0:
                j += 1
                continue
            # Along a run of the row only x varies: its powers are all there is to sum.
            distance = 1 / slope
            p0 = p1 = p2 = p3 = p4 = v0 = v1 = v2 = squares = metres = deviations = 0.0
            while j < width and regions[i, j] == label:
                ray = rays[i, j]
                value = inverse[i, j] - (plane[0] * ray[0] + plane[1] * ray[1] + plane[2] * ray[2])
                root = np.sqrt(weight[i, j])
                value *= root
                if abs(value) <= limit[label]:
                    squares += value * value
                    # An error of the inverse leaves the plane by distance / inverse times as much.
                    deviations += distance / (root * inverse[i, j])
                    if i > 0 and j > 0 and inverse[i - 1, j] > 0 and inverse[i, j - 1] > 0:
                        across, along = 0.0, 0.0
                        for k in range(3):
                            across += (ray[k] - rays[i, j - 1, k]) ** 2
                            along += (ray[k] - rays[i - 1, j, k]) ** 2
                        length = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
                        # Seen face on it is smaller by the cosine, distance inverse / length.
                        face = np.sqrt(across * along) / inverse[i, j] ** 2
                        metres += face * length / (distance * inverse[i, j])
                    x = 2 * j / width - 1
                    square = x * x
                    p0, p1, p2 = p0 + 1, p1 + x, p2 + square
                    p3, p4 = p3 + square * x, p4 + square * square
                    v0, v1, v2 = v0 + value, v1 + value * x, v2 + value * square
                j += 1
            total[label] += squares
            area[label] += metres
            scale[label] += deviations
            power, response = (p0, p1, p2, p3, p4), (v0, v1, v2)
            for a in range(6):
                right[label, a] += y ** _Y[a] * response[_X[a]]
                for b in range(6):
                    normal[label, a, b] += y ** (_Y[a] + _Y[b]) * power[_X[a] + _X[b]]
    return normal, right, total, area, scale
