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

from rangeseg_ros.core.by_planes.blocks import NODE
from rangeseg_ros.core.by_planes.shifts import Shifts, shift_at
from rangeseg_ros.core.graphcut.energy import link_costs
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.moments import COUNT, RATIO, SIZE, SLOPE, add_pixel, fit_all
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    random_variance,
    systematic_variance,
)
from rangeseg_ros.core.significance import OUTLIER, chi2_quantile

NO_PLANE = chi2_quantile(1) / 2
"""Data cost of label 0: that of a residual which is no chance."""
LEAST_GAIN = 1e-6
"""An improvement of the energy by less is rounding."""
CAP = OUTLIER**2 / 2
"""The largest data cost: that of an outlier, minus the logarithm of a likelihood."""


class Problem(NamedTuple):
    """What the labelling has to explain: n pixels in raster order.

    Attributes
    ----------
    inverse, rays : (n,), (n, 3) float32
        Range image.
    pinhole : bool
        Of it: whether rays of a column differ in y alone, and those of a row not in y.
    weight : (n,) float32
        1 / random variance of the inverse range; 0 where nothing was measured.
    links : (2, n) float32
        Cost of unlike labels across the edges to the right and down, see `link_costs`.
    width : int
        Columns of the image.
    """

    inverse: NDArray[np.float32]
    rays: NDArray[np.float32]
    pinhole: bool
    weight: NDArray[np.float32]
    links: NDArray[np.float32]
    width: int

    @classmethod
    def of(
        cls,
        image: RangeImage,
        sensor: SensorModel,
        grid: Grid,
        smoothness: float,
    ) -> Problem:
        """Weigh the pixels of an image by the noise of its sensor.

        The prior is `smoothness` for each pixel that counts as one measurement with its
        neighbours.
        """
        inverse, rays = image.inverse.ravel(), image.rays.reshape(-1, 3)
        weight = _weights(inverse, sensor)
        prior = link_costs(grid, smoothness * sensor.patch)
        width = image.shape[1]
        return cls(inverse, rays, image.pinhole, weight, prior, width)


def pixel_weights(inverse: NDArray[np.float32], sensor: SensorModel) -> NDArray[np.float32]:
    """1 / random variance of inverse ranges; 0 where nothing was measured."""
    return _weights(inverse.ravel(), sensor).reshape(inverse.shape)


# Divides by zero where numpy does, and without branches, so that many pixels are taken at a time.
@njit(cache=True, nogil=True, error_model='numpy')
def _weights(inverse: NDArray[np.float32], sensor: SensorModel) -> NDArray[np.float32]:
    weight = np.empty_like(inverse)
    for p in range(len(inverse)):
        y = np.float64(inverse[p])
        weight[p] = (y > 0) / random_variance(sensor, y * y)
    return weight


class Models(NamedTuple):
    """The planes that are labels.

    Attributes
    ----------
    theta : (K + 1, 3) float64
        theta . ray = inverse range; entry 0 is no plane.
    half_precision : (K + 1,) float64
        Half of the random variance over that which is granted: what a squared residual in random
        variances costs.
    shifts : Shifts
        How much nearer the planes look at each block.
    """

    theta: NDArray[np.float64]
    half_precision: NDArray[np.float64]
    shifts: Shifts

    @classmethod
    def of(cls, moments: NDArray[np.float64], smooth: float) -> Models:
        """Planes of moment vectors (K + 1, 13), as yet without shifts.

        Regions of `smooth` pixels meet half the variance of the distortion.
        """
        theta, _ = fit_all(moments)
        count = np.maximum(moments[:, COUNT], 1)
        ratio = moments[:, RATIO] / (count + smooth)
        granted = (1 + moments[:, SLOPE] / count) * (1 + ratio)
        return cls(theta, 0.5 / granted, Shifts.none(len(theta)))


def energy(labels: NDArray[np.int32], problem: Problem, models: Models) -> float:
    """Value of eq. 5.3 for labels (n,): data costs and the costs of the edges between unlike."""
    below = problem.links[1, : -problem.width]
    right = problem.links[0, :-1]  # 0 from the end of one row to the next
    unlike = right[labels[1:] != labels[:-1]].sum(dtype=np.float64)
    unlike += below[labels[problem.width :] != labels[: -problem.width]].sum(dtype=np.float64)
    return float(costs(labels, problem, models).sum(dtype=np.float64) + unlike)


@njit(cache=True)
def data_cost(label: int, p: int, problem: Problem, models: Models) -> float:
    """What a label costs a measured pixel."""
    if label == 0:
        return NO_PLANE
    # Unsigned and short, which divides in a fraction of the time.
    place, width, block = np.uint32(p), np.uint32(problem.width), np.uint32(NODE)
    i, j = place // width, place % width
    row, column, along = np.intp(i // block), np.intp(j // block), int(np.intp(j))
    plane = shifted_plane(label, shift_at(models.shifts, label, int(row), int(column)), models)
    return plane_cost(plane, p - along, along, problem)


@njit(cache=True)
def shifted_plane(
    label: int, shift: float, models: Models
) -> tuple[float, float, float, float, float]:
    """A plane for `plane_cost`: theta, 1 + shift and half its precision, read once for many."""
    theta = models.theta
    return (
        theta[label, 0],
        theta[label, 1],
        theta[label, 2],
        1 + shift,
        models.half_precision[label],
    )


@njit(cache=True)
def plane_cost(
    plane: tuple[float, float, float, float, float], begin: int, j: int, problem: Problem
) -> float:
    """What a plane costs the pixel in column j of a row; 0 where nothing was measured.

    `begin` is the number of the first pixel of the row.
    """
    a, b, c, scale, half_precision = plane
    rays, p = problem.rays, begin + j
    # Numbers that stay in cache, where the rays of all pixels do not.
    first, second = (j, begin) if problem.pinhole else (p, p)
    level = a * rays[first, 0] + b * rays[second, 1] + c * rays[first, 2]
    residual = problem.inverse[p] - scale * level
    return min(half_precision * problem.weight[p] * residual * residual, CAP)


@njit(cache=True)
def costs(labels: NDArray[np.int32], problem: Problem, models: Models) -> NDArray[np.float32]:
    """What each pixel's label costs it, (n,); 0 where nothing was measured."""
    cost = np.zeros(len(labels), np.float32)
    for p in range(len(labels)):
        if problem.weight[p] > 0:
            cost[p] = data_cost(labels[p], p, problem, models)
    return cost


def region_moments(
    labels: NDArray[np.integer],
    count: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    weight: NDArray[np.float32],
    sensor: SensorModel,
) -> NDArray[np.float64]:
    """Moments of the pixels of each label.

    Parameters
    ----------
    labels : (H, W) int
    count : int
        Number of labels, 0 included.
    inverse, rays : (H, W), (H, W, 3) float32
        Range image.
    weight : (H, W) float32
        1 / random variance of the inverse range.
    sensor : SensorModel
        Its distortion is read.

    Returns
    -------
    (count, 13) float64
        Zeros for label 0.
    """
    upper, lower = map_halves(
        _sum_moments, len(labels), labels, count, inverse, rays, weight, sensor
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
    sensor: SensorModel,
) -> NDArray[np.float64]:
    total = np.zeros((count, SIZE))
    for i in range(first, after):
        for j in range(labels.shape[1]):
            label, y, w = labels[i, j], np.float64(inverse[i, j]), np.float64(weight[i, j])
            if label > 0:
                ratio = w * systematic_variance(sensor, y * y)
                add_pixel(total[label], rays[i, j], y, w, ratio)
                total[label, COUNT] += 1
    return total
