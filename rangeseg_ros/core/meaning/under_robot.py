"""Which surface the robot stands on, and the plane of the ground under it.

The height above the stated ground is a + b x + c y for a plane, with x, y horizontal: a is the
error of the stated height, b and c are that of the tilt, or the slope of the ground. The plane is
the most probable one (ridge regression): of the cells of a surface and of what is known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import Cells, axes_of
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance

HEIGHT, TILT = 0.015, float(np.radians(1.5))
"""How well a robot knows its camera: standard deviations of height, metres, and tilt, radians."""
FEWEST = 24
"""Cells that can be a ground: less is the foot of something."""
# Metres of a surface, from where it begins, that tell its plane under the robot; fewer when the
# ground begins with a ramp.
_WAYS = (0.7, 0.2)
# What makes a surface less probable by a factor e: that much farther away, metres.
_FARTHER = 0.25
# How probable it is that the robot stands on a ramp, or a ramp begins before the ground is seen.
_RAMP = 0.02
# The squared deviation, in variances, from which what is known and what is seen contradict.
_MISFIT = 25.0
# Logarithm of a share of the probability that nobody would notice.
_HOPELESS = 30.0
# Largest surfaces that are looked at.
_MOST = 32


class Stand(NamedTuple):
    """Where a robot stands.

    Attributes
    ----------
    surface : int
        Of the ground; 0 where none is found.
    theta : (3,) float64
        Plane of the ground under the robot.
    confidence : float
        0...1: that it is this surface and no other one.
    """

    surface: int
    theta: NDArray[np.float64]
    confidence: float

    def height(self, up: NDArray[np.float64]) -> float:
        """Of the sensor above the ground below it, along `up`, metres; NaN without a ground."""
        return float(-1 / (self.theta @ up)) if self.surface else float('nan')


def stand(
    cells: Cells,
    surface: NDArray[np.int32],
    up: NDArray[np.float64],
    sensor: SensorModel,
    known: tuple[float, float],
    slope: float,
) -> Stand:
    """Find the surface under the robot.

    The probability of a surface is its size, times how well what is known agrees with it, and
    less for what is farther away than others. Without a height, it is the surface that reaches
    nearest to below the sensor.

    Parameters
    ----------
    cells : Cells
    surface : (rows, columns) int32
        1...N, 0 for none.
    up : (3,) float64
    sensor : SensorModel
    known : (float, float)
        Height of the sensor above the ground below it and its standard deviation, metres; 0, 0
        when nothing is known.
    slope : float
        Steepest ground, radians.
    """
    height, doubt = known
    sizes = np.bincount(surface.ravel())
    sizes[0] = 0
    order = np.argsort(-sizes, kind='stable')[:_MOST]
    order = order[sizes[order] >= FEWEST]
    if not len(order):
        return Stand(0, np.zeros(3), 0.0)
    reach, steepest = _reaches(cells, surface, len(sizes))
    rank = np.full(len(sizes), -1)
    rank[order] = np.arange(len(order))
    sums = _sums(cells, surface, rank, reach, sensor, height)
    horizontal = axes_of(up)[1:]
    ramp = -np.log(_RAMP)
    scores: list[float] = []
    planes: list[NDArray[np.float64]] = []
    for k, total in zip(order, sums, strict=True):
        base = np.log(sizes[k]) - (reach[k] - reach[order].min()) / _FARTHER
        if height == 0:
            # A metre farther from below the sensor, for each metre of its height.
            base -= steepest[k] / _FARTHER
        best = -np.inf, np.zeros(3)
        if scores and base < max(scores) - _HOPELESS:
            scores.append(-np.inf)
            planes.append(best[1])
            continue
        for way, tilt, rarity in ((0, TILT, 0.0), (0, slope, ramp), (1, TILT, ramp)):
            spread = np.array([doubt or 1e3, tilt, tilt])
            solved, misfit = _solved(total[way], spread)
            below = height - solved[0]
            if misfit < _MISFIT and below > 0.02:
                theta = -(up - solved[1:] @ horizontal) / below
                best = max(best, (base - misfit / 2 - rarity, theta), key=lambda found: found[0])
        scores.append(best[0])
        planes.append(best[1])
    winner = int(np.argmax(scores))
    if scores[winner] == -np.inf:
        return Stand(0, np.zeros(3), 0.0)
    share = np.exp(np.array(scores) - scores[winner])
    return Stand(int(order[winner]), planes[winner], float(1 / share.sum()))


@njit(cache=True, nogil=True)
def _reaches(
    cells: Cells, surface: NDArray[np.int32], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least horizontal distance of surfaces, metres, and the least ratio of it to the depth."""
    reach = np.full(count, np.inf)
    ratio = np.full(count, np.inf)
    for i in range(surface.shape[0]):
        for c in range(surface.shape[1]):
            k = surface[i, c]
            if k:
                z, x, y = cells.place[i, c]
                way = np.sqrt(x * x + y * y)
                reach[k] = min(reach[k], way)
                ratio[k] = min(ratio[k], way / max(-z, np.float32(1e-3)))
    return reach, ratio


@njit(cache=True, nogil=True)
def _sums(
    cells: Cells,
    surface: NDArray[np.int32],
    rank: NDArray[np.int64],
    reach: NDArray[np.float64],
    sensor: SensorModel,
    stated: float,
) -> NDArray[np.float64]:
    """Sums of the regression, (K, 2, 10), for the cells of the two ways of each surface.

    Weighted by the variance of one cell's height as if all of a patch of the distortion were one
    measurement.
    """
    # Cells under the square of a Gaussian of the distortion's width; a cell has about 8 pixels.
    patch = max(4 * np.pi * sensor.distortion_length**2 / 8, 1.0)
    sums = np.zeros((rank.max() + 1, 2, 10))
    for i in range(surface.shape[0]):
        for c in range(surface.shape[1]):
            k = surface[i, c]
            if k == 0 or rank[k] < 0:
                continue
            z, x, y = cells.place[i, c]
            way = np.sqrt(x * x + y * y) - reach[k]
            if way > _WAYS[0]:
                continue
            square = cells.inverse[i, c] ** 2
            variance = random_variance(sensor, square)
            variance += patch * systematic_variance(sensor, square)
            w = square / (max(z * z, np.float32(1e-6)) * variance)
            h = z + stated
            entries = (w, w * x, w * y, w * x * x, w * x * y, w * y * y, w * h, w * h * x)
            for side in range(2):
                if way <= _WAYS[side]:
                    total = sums[rank[k], side]
                    for n in range(8):
                        total[n] += entries[n]
                    total[8] += w * h * y
                    total[9] += w * h * h
    return sums


def _solved(
    total: NDArray[np.float64], spread: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """a, b, c with zero means and these standard deviations; what that costs beyond a free fit."""
    one, x, y, xx, xy, yy = total[:6]
    matrix = np.array([[one, x, y], [x, xx, xy], [y, xy, yy]])
    vector = total[6:9]
    solved = np.linalg.solve(matrix + np.diag(spread**-2.0), vector)
    free = np.linalg.lstsq(matrix, vector, rcond=1e-12)[0]
    # Both residual sums, without what they have in common.
    bound = solved @ matrix @ solved - 2 * solved @ vector + ((solved / spread) ** 2).sum()
    misfit = bound - (free @ matrix @ free - 2 * free @ vector)
    return solved, max(float(misfit), 0.0)
