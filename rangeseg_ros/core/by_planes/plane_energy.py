"""What planes cost as labels: the energy of thesis eq. 5.3, see docs/method.md."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Ints, Singles
from rangeseg_ros.core.by_planes.offsets import Offsets, offset_at
from rangeseg_ros.core.graphcut.expansion import link_costs
from rangeseg_ros.core.sensing.blocks import NODE
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.moments import COUNT, RATIO, SLOPE, fit_all
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.significance import OUTLIER, chi2_quantile

NO_PLANE = chi2_quantile(1) / 2
"""Data cost of label 0: that of a residual which is no chance."""
LEAST_GAIN = 1e-6
"""An improvement of the energy by less is rounding."""
CAP = OUTLIER**2 / 2
"""The largest data cost: that of an outlier, minus the logarithm of a likelihood."""


class Problem(NamedTuple):
    """What the labelling has to explain: n pixels in raster order.

    `pinhole`: whether rays of a column differ in y alone, and those of a row not in y.
    """

    inverse: Singles  # (n,)
    rays: Singles  # (n, 3)
    pinhole: bool
    weight: Singles  # (n,), 1 / random variance, 0 where nothing was measured
    links: Singles  # (2, n), see `link_costs`
    width: int  # columns of the image

    @classmethod
    def of(cls, image: RangeImage, sensor: SensorModel, grid: Grid, smoothness: float) -> Problem:
        """Weigh the pixels of an image by the noise of its sensor.

        The prior is `smoothness` for each pixel that counts as one measurement with its
        neighbours.
        """
        inverse, rays = image.inverse.ravel(), image.rays.reshape(-1, 3)
        prior = link_costs(grid, smoothness * sensor.pixel_inflation)
        weight = _weights(inverse, sensor)
        return cls(inverse, rays, image.pinhole, weight, prior, image.shape[1])


# Divides by zero where numpy does, and without branches, so that many pixels are taken at a time.
@njit(cache=True, nogil=True, error_model='numpy')
def _weights(inverse: Singles, sensor: SensorModel) -> Singles:
    """1 / random variance of inverse ranges (n,); 0 where nothing was measured."""
    weight = np.empty(len(inverse), np.float32)
    for p in range(len(inverse)):
        y = np.float64(inverse[p])
        weight[p] = (y > 0) / random_variance(sensor, y * y)
    return weight


class Models(NamedTuple):
    """The planes theta . ray = inverse range (K + 1, 3) that are labels; entry 0 is no plane.

    `half_precision` (K + 1,) is half of the random variance over that which is granted: what a
    squared residual in random variances costs. `offsets`: how much nearer they look at each block.
    """

    theta: Floats
    half_precision: Floats
    offsets: Offsets

    @classmethod
    def of(cls, moments: Floats, smooth: float) -> Models:
        """Planes of moment vectors (K + 1, 13), as yet without offsets.

        Regions of `smooth` pixels meet half the variance of the distortion.
        """
        theta, _ = fit_all(moments)
        count = np.maximum(moments[:, COUNT], 1)
        granted = (1 + moments[:, SLOPE] / count) * (1 + moments[:, RATIO] / (count + smooth))
        return cls(theta, 0.5 / granted, Offsets.none(len(theta)))


@njit(cache=True)
def data_cost(label: int, p: int, problem: Problem, models: Models) -> float:
    """What a label costs a measured pixel.

    Call it with numbers of type intp: it is compiled once for each type of integer.
    """
    if label == 0:
        return NO_PLANE
    # Unsigned and short, which divides in a fraction of the time.
    place, width, block = np.uint32(p), np.uint32(problem.width), np.uint32(NODE)
    i, j = place // width, place % width
    row, column, along = int(np.intp(i // block)), int(np.intp(j // block)), int(np.intp(j))
    # Numbers that stay in cache, where the rays of all pixels do not.
    first, second = (along, p - along) if problem.pinhole else (p, p)
    theta, rays = models.theta, problem.rays
    level = theta[label, 0] * rays[first, 0] + theta[label, 1] * rays[second, 1]
    level += theta[label, 2] * rays[first, 2]
    residual = problem.inverse[p] - (1 + offset_at(models.offsets, label, row, column)) * level
    return min(models.half_precision[label] * problem.weight[p] * residual * residual, CAP)


@njit(cache=True)
def costs(labels: Ints, problem: Problem, models: Models) -> Singles:
    """What each pixel's label costs it, (n,); 0 where nothing was measured."""
    cost = np.zeros(len(labels), np.float32)
    for p in range(len(labels)):
        if problem.weight[p] > 0:
            cost[p] = data_cost(int(np.intp(labels[p])), p, problem, models)
    return cost
