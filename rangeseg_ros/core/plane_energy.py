"""What planes cost as labels: the energy of thesis eq. 5.3 with residuals for angles.

The data cost of a plane is the squared residual in variances of the sensor, capped; label 0
stands for what no plane explains and has a fixed cost; the prior is Potts over the neighbourhood
weights.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.expansion import links
from rangeseg_ros.core.growing import DISTORTION_PIXELS
from rangeseg_ros.core.moments import COUNT, RATIO, SIZE, SLOPE, fit_all
from rangeseg_ros.core.range_image import RangeImage
from rangeseg_ros.core.sensor import FLOOR, SensorModel
from rangeseg_ros.core.threads import halves

# Noise agrees over patches of about this many pixels, so that many count as one measurement.
_PATCH = 3.0
_SMOOTHNESS = 1.2
NO_PLANE = 6.0 / _PATCH
"""Data cost of label 0."""
_CAP = 8.0 / _PATCH
# Systematic variances granted to the pixels of a plane.
_GRANTED = 2.0


class Problem(NamedTuple):
    """What the labelling has to explain.

    Attributes
    ----------
    inverse, rays : (H, W), (H, W, 3) float32
        Range image.
    weight : (H, W) float32
        1 / random variance of the inverse range; 0 where nothing was measured.
    links : (H * W, 4) float32
        Cost of unlike labels across each pixel's edges: right, down, left, up.
    block : int
        Rows and columns of the blocks that surfaces are grown from.
    """

    inverse: NDArray[np.float32]
    rays: NDArray[np.float32]
    weight: NDArray[np.float32]
    links: NDArray[np.float32]
    block: int

    @classmethod
    def of(
        cls,
        image: RangeImage,
        sensor: SensorModel,
        horizontal: NDArray[np.float32],
        vertical: NDArray[np.float32],
        block: int,
    ) -> Problem:
        """Weigh the pixels of an image by the noise of its sensor."""
        weight = _weights(image.inverse, sensor.noise, sensor.range_noise)
        prior = links(horizontal, vertical, _SMOOTHNESS)
        return cls(image.inverse, image.rays, weight, prior, block)


@njit(cache=True, nogil=True)
def _weights(
    inverse: NDArray[np.float32], noise: float, range_noise: float
) -> NDArray[np.float32]:
    weight = np.zeros_like(inverse)
    for i in range(inverse.shape[0]):
        for j in range(inverse.shape[1]):
            y = np.float64(inverse[i, j])
            if y > 0:
                weight[i, j] = 1 / (FLOOR + noise**2 + (range_noise * y * y) ** 2)
    return weight


class Models(NamedTuple):
    """The planes that are labels.

    Attributes
    ----------
    theta : (K + 1, 3) float64
        theta . ray = inverse range; entry 0 is no plane.
    price : (K + 1,) float64
        Data cost of a residual of one random variance: the less, the more variance is granted.
    """

    theta: NDArray[np.float64]
    price: NDArray[np.float64]

    @classmethod
    def of(cls, moments: NDArray[np.float64]) -> Models:
        """Planes of moment vectors (K + 1, 13)."""
        theta, _ = fit_all(moments)
        count = np.maximum(moments[:, COUNT], 1)
        ratio = moments[:, RATIO] / (count + DISTORTION_PIXELS)
        granted = 1 + moments[:, SLOPE] / count + _GRANTED * ratio
        return cls(theta, 0.5 / _PATCH / granted)


def energy(labels: NDArray[np.int32], problem: Problem, models: Models) -> float:
    """Value of eq. 5.3: data costs plus the weights of the edges between unlike labels."""
    cost = costs(labels, problem, models)
    prior = problem.links.reshape(*labels.shape, 4)
    unlike = prior[:, :-1, 0][labels[:, 1:] != labels[:, :-1]].sum(dtype=np.float64)
    unlike += prior[:-1, :, 1][labels[1:] != labels[:-1]].sum(dtype=np.float64)
    return float(cost.sum(dtype=np.float64) + unlike)


@njit(cache=True)
def data_cost(label: int, p: int, problem: Problem, models: Models) -> float:
    """What a label costs a measured pixel, given by its number in raster order."""
    if label == 0:
        return NO_PLANE
    i, j = divmod(p, problem.inverse.shape[1])
    plane, ray = models.theta[label], problem.rays[i, j]
    residual = problem.inverse[i, j] - (plane[0] * ray[0] + plane[1] * ray[1] + plane[2] * ray[2])
    return min(models.price[label] * problem.weight[i, j] * residual * residual, _CAP)


@njit(cache=True)
def costs(labels: NDArray[np.int32], problem: Problem, models: Models) -> NDArray[np.float32]:
    """What each pixel's label costs it, (H, W); 0 where nothing was measured."""
    width = labels.shape[1]
    cost = np.zeros(labels.shape, np.float32)
    for i in range(labels.shape[0]):
        for j in range(width):
            if problem.weight[i, j] > 0:
                cost[i, j] = data_cost(labels[i, j], i * width + j, problem, models)
    return cost


def region_moments(
    problem: Problem, labels: NDArray[np.integer], count: int, sensor: SensorModel
) -> NDArray[np.float64]:
    """Moments (count, 13) of the pixels of each label."""
    upper, lower = halves(
        _sum_moments,
        len(labels),
        labels,
        count,
        problem.inverse,
        problem.rays,
        problem.weight,
        sensor.distortion,
        sensor.range_distortion,
    )
    return upper + lower


@njit(cache=True, nogil=True)
def _sum_moments(
    first: int,
    after: int,
    labels: NDArray[np.integer],
    count: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    weight: NDArray[np.float32],
    distortion: float,
    range_distortion: float,
) -> NDArray[np.float64]:
    total = np.zeros((count, SIZE))
    width = labels.shape[1]
    for i in range(first, after):
        j = 0
        while j < width:
            label = labels[i, j]
            if label == 0:
                j += 1
                continue
            # In variables of their own: sums in an array go through memory for every pixel.
            a = b = c = d = e = f = p = q = r = square = pixels = ratio = 0.0
            while j < width and labels[i, j] == label:
                y, w = np.float64(inverse[i, j]), np.float64(weight[i, j])
                x0 = np.float64(rays[i, j, 0])
                x1 = np.float64(rays[i, j, 1])
                x2 = np.float64(rays[i, j, 2])
                wx0, wx1, wx2, wy = w * x0, w * x1, w * x2, w * y
                a, b, c = a + wx0 * x0, b + wx0 * x1, c + wx0 * x2
                d, e, f = d + wx1 * x1, e + wx1 * x2, f + wx2 * x2
                p, q, r = p + x0 * wy, q + x1 * wy, r + x2 * wy
                square += wy * y
                pixels += 1
                ratio += w * (distortion**2 + (range_distortion * y * y) ** 2)
                j += 1
            sums = (a, b, c, d, e, f, p, q, r, square, pixels, ratio)
            for entry, value in enumerate(sums):
                total[label, entry] += value
    return total
