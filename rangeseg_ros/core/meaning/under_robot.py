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
from rangeseg_ros.core.sensing.moments import cofactors
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import SAMPLES

# Metres of a surface, from where it begins, that tell its plane under the robot; fewer when the
# ground begins with a ramp.
_WAYS = (0.7, 0.2)
NEAR = 0.25
"""Metres that are near: a surface so much farther away is less probable by a factor e."""
# How probable it is that the robot stands on a ramp, or a ramp begins before the ground is seen.
_RAMP = 0.02
# The squared deviation, in variances, from which what is known and what is seen contradict.
_MISFIT = 25.0
# Largest surfaces that are looked at.
_MAX_SURFACES = 32


class Stand(NamedTuple):
    """Where a robot stands.

    Attributes
    ----------
    surface : int
        Of the ground; 0 where none is found.
    theta : (3,) float64
        Plane of the ground under the robot.
    confidence : float
        0...1: that it is this surface and no other one; and without a height that it is no
        table: where more of its edge falls off than ends at what stands on it, less than 0.5.
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
    count: int,
    up: NDArray[np.float64],
    sensor: SensorModel,
    known: tuple[float, float],
    slope: float,
    tilt: float,
) -> Stand:
    """Find the surface under the robot.

    More than seven parameters: the last four are what is known beforehand, each by itself.

    The probability of a surface is its size, times how well what is known agrees with it, and
    less for what is farther away than others. Without a height, it is the surface that reaches
    nearest to below the sensor.

    Parameters
    ----------
    cells : Cells
    surface : (rows, columns) int32
        1...N, 0 for none.
    count : int
        N.
    up : (3,) float64
    sensor : SensorModel
    known : (float, float)
        Height of the sensor above the ground below it and its standard deviation, metres; 0, 0
        when nothing is known.
    slope : float
        Steepest ground, radians.
    tilt : float
        Standard deviation of `up`, radians.
    """
    winner, below, *lean, confidence = _most_probable(
        cells, surface, count, sensor, known, slope, tilt
    )
    if winner == 0:
        return Stand(0, np.zeros(3), 0.0)
    theta = -(up - np.array(lean) @ axes_of(up)[1:]) / (known[0] - below)
    return Stand(winner, theta, confidence)


@njit(cache=True, nogil=True)
def _most_probable(
    cells: Cells,
    surface: NDArray[np.int32],
    count: int,
    sensor: SensorModel,
    known: tuple[float, float],
    slope: float,
    tilt: float,
) -> tuple[int, float, float, float, float]:
    """The surface, or 0; what is known errs by so much if it is the ground; and its confidence.

    See `stand`, and a, b, c of `_scores`.
    """
    height, doubt = known
    sizes, reach, steepest = _reaches(cells, surface, count + 1, height == 0)
    order = np.flatnonzero(sizes >= SAMPLES)
    if len(order) == 0:
        return 0, 0.0, 0.0, 0.0, 0.0
    order = order[np.argsort(-sizes[order], kind='mergesort')[:_MAX_SURFACES]]
    rank = np.full(len(sizes), -1)
    rank[order] = np.arange(len(order))
    sums = _sums(cells, surface, rank, reach, sensor, height)
    base = np.log(sizes[order]) - (reach[order] - reach[order].min()) / NEAR
    if height == 0:
        # A metre farther from below the sensor, for each metre of its height.
        base -= steepest[order] / NEAR
    scores, planes = _scores(sums, base, height, doubt if doubt > 0 else 1e3, slope, tilt)
    winner = np.argmax(scores)
    if scores[winner] == -np.inf:
        return 0, 0.0, 0.0, 0.0, 0.0
    below, ahead, aside = planes[winner]
    share = np.exp(scores - scores[winner])
    return order[winner], below, ahead, aside, 1 / share.sum()


@njit(cache=True, nogil=True)
def _reaches(
    cells: Cells, surface: NDArray[np.int32], count: int, steepness: bool
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Cells of surfaces, least horizontal distance, metres, least ratio of it to the depth.

    The ratio only where `steepness` is asked for; inf otherwise.
    """
    sizes = np.zeros(count, np.int64)
    nearest = np.full(count, np.float32(np.inf))
    ratio = np.full(count, np.inf)
    for i in range(surface.shape[0]):
        for c in range(surface.shape[1]):
            k = surface[i, c]
            if k:
                z, x, y = cells.place[0, i, c], cells.place[1, i, c], cells.place[2, i, c]
                square = x * x + y * y
                sizes[k] += 1
                nearest[k] = min(nearest[k], square)
                if steepness:
                    ratio[k] = min(ratio[k], np.sqrt(square) / max(-z, np.float32(1e-3)))
    return sizes, np.sqrt(nearest).astype(np.float64), ratio


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
    patch = max(4 * np.pi * sensor.distortion_length**2 / 16, 1.0)
    sums = np.zeros((rank.max() + 1, 2, 10))
    for i in range(surface.shape[0]):
        for c in range(surface.shape[1]):
            k = surface[i, c]
            if k == 0 or rank[k] < 0:
                continue
            z, x, y = cells.place[0, i, c], cells.place[1, i, c], cells.place[2, i, c]
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


@njit(cache=True, nogil=True)
def _scores(
    sums: NDArray[np.float64],
    base: NDArray[np.float64],
    height: float,
    doubt: float,
    slope: float,
    tilt: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Logarithms of the probabilities of surfaces, and what each errs by if it is the ground.

    Parameters
    ----------
    sums : (K, 2, 10) float64
        See `_sums`.
    base : (K,) float64
        Logarithms of the probabilities but for what is known.
    height, doubt : float
        Of the sensor, and its standard deviation, metres.
    slope, tilt : float
        Steepest ground, and the standard deviation of up, radians.

    Returns
    -------
    scores : (K,) float64
        -inf where what is known contradicts.
    planes : (K, 3) float64
        a, b, c.
    """
    scores = np.full(len(base), -np.inf)
    planes = np.zeros((len(base), 3))
    for k in range(len(base)):
        # Level ground, a ramp, and a ramp that is left soon.
        for way, lean, rarity in ((0, tilt, 1.0), (0, slope, _RAMP), (1, tilt, _RAMP)):
            a, b, c, misfit = _solved(sums[k, way], doubt, lean)
            score = base[k] - misfit / 2 + np.log(rarity)
            # Nothing less than 2 cm below is a ground.
            if misfit < _MISFIT and height - a > 0.02 and score > scores[k]:
                scores[k] = score
                planes[k, 0], planes[k, 1], planes[k, 2] = a, b, c
    return scores, planes


@njit(cache=True, nogil=True)
def _solved(
    total: NDArray[np.float64], doubt: float, tilt: float
) -> tuple[float, float, float, float]:
    """a, b, c with zero means and these standard deviations; what that costs beyond a free fit."""
    a, b, c = solve_plane(total, doubt**-2.0, tilt**-2.0)
    # Where the cells lie on a line, any plane through it.
    least = 1e-12 * (total[0] + total[3] + total[5])
    p, q, r = solve_plane(total, least, least)
    # Both residual sums, without what they have in common.
    bound = _residual(total, a, b, c) + (a / doubt) ** 2 + (b * b + c * c) / tilt**2
    return a, b, c, max(bound - _residual(total, p, q, r), 0.0)


@njit(cache=True, nogil=True)
def solve_plane(
    total: NDArray[np.float64], first: float, others: float
) -> tuple[float, float, float]:
    """Coefficients a, b, c of the least-squares plane h = a + b x + c y, by Cramer's rule.

    Parameters
    ----------
    total : (9,) float64 or more
        Weighted sums of 1, x, y, x^2, xy, y^2, h, xh, yh.
    first, others : float
        Added to the diagonal: for a, for b and c.
    """
    a, b, c = total[0] + first, total[1], total[2]
    d, e, f = total[3] + others, total[4], total[5] + others
    x, y, z = total[6], total[7], total[8]
    aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
    return (
        (aa * x + bb * y + cc * z) / determinant,
        (bb * x + dd * y + ee * z) / determinant,
        (cc * x + ee * y + ff * z) / determinant,
    )


@njit(cache=True, nogil=True)
def _residual(total: NDArray[np.float64], a: float, b: float, c: float) -> float:
    """Sum of the weighted squares that a plane leaves, less that of the heights."""
    square = total[0] * a * a + total[3] * b * b + total[5] * c * c
    mixed = total[1] * a * b + total[2] * a * c + total[4] * b * c
    return square + 2 * mixed - 2 * (total[6] * a + total[7] * b + total[8] * c)
