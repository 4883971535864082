"""Where the ground under the robot is, by what is stated and by what is seen, with its error.

The height above the stated ground is a + b x + c y for a plane, with x, y horizontal: a is the
step between the ground seen, continued, and the ground stated; b and c are a slope, or the error
of up. A plane that is continued to below the camera does not depend on the direction that is
called up, so that a slope under the robot is no contradiction, and a level landing is one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.moments import cofactors
from rangeseg_ros.core.significance import SAMPLES

# Metres of ground, from where it begins, that are continued to below the camera: each doubles the
# one before. A short one is right where a ramp begins, a long one where the ground undulates.
_WAYS = (0.4, 0.8, 1.6, 3.2)
# How often there is a step out of view between a robot and the ground it sees, and the highest.
_STEPS, HIGHEST = 0.1, 0.35
# Metres: what is smaller is no floor, such as a hand or a fork before the camera.
_SMALL = 0.25


class Stand(NamedTuple):
    """Where a robot stands.

    Attributes
    ----------
    surface : int
        1 where the ground is in view, 0 where it is not known.
    theta : (3,) float64
        Plane of the ground under the robot: theta . ray is its inverse range.
    confidence : float
        0...1: probability that the ground seen is the one that the robot stands on.
    reasons : tuple of str
        What contradicts, in words.
    """

    surface: int
    theta: NDArray[np.float64]
    confidence: float
    reasons: tuple[str, ...] = ()

    def height(self, up: NDArray[np.float64]) -> float:
        """Of the sensor above the ground below it, along `up`, metres; NaN without a ground."""
        return float(-1 / (self.theta @ up)) if self.surface else float('nan')


class Continuation(NamedTuple):
    """The ground that is seen, continued to below the camera, against the one that is stated.

    Attributes
    ----------
    plane : (a, b, c)
        Of the ground seen, above the stated ground.
    error : float
        Standard deviation of a, that of the stated height included, metres.
    confidence : float
        That there is no step out of view between the robot and the ground it sees.
    size : float
        The longer side of the rectangle around the ground seen, metres.
    """

    plane: tuple[float, float, float]
    error: float
    confidence: float
    size: float

    def behind_step(self, nearer: Continuation, highest: float) -> bool:
        """Whether nearer ground may be the robot's own, and this one a step of it, metres."""
        apart = abs(self.plane[0] - nearer.plane[0])
        return nearer.size > _SMALL and apart < highest


def no_step(a: float, sd: float, least: float) -> float:
    """Probability that ground `a` metres off the stated one, +- `sd`, is no step of `least`.

    By Bayes' rule: one ground in `_STEPS` lies behind a step that is uniform up to `HIGHEST`.
    """
    same = (1 - _STEPS) * math.exp(-((a / sd) ** 2) / 2) / (sd * math.sqrt(2 * math.pi))
    tails = sum(math.erfc((least - side * a) / (sd * math.sqrt(2))) / 2 for side in (-1, 1))
    step = _STEPS * tails / (2 * max(HIGHEST - least, least))
    return same / (same + step) if same > 0 else 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def solve(
    total: NDArray[np.float64],
    first: float,
    others: float,
    prior: tuple[float, float, float],
) -> tuple[float, float, float, float]:
    """Plane h = a + b x + c y by least squares: a, b, c and the variance of a.

    Parameters
    ----------
    total : (9,) float64
        Weighted sums of 1, x, y, xx, xy, yy, h, xh, yh.
    first, others : float
        Inverse variances of the prior: of a, of b and c.
    prior : (a, b, c)
    """
    a, b, c = total[0] + first, total[1], total[2]
    d, e, f = total[3] + others, total[4], total[5] + others
    x = total[6] + first * prior[0]
    y, z = total[7] + others * prior[1], total[8] + others * prior[2]
    aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
    return (
        (aa * x + bb * y + cc * z) / determinant,
        (bb * x + dd * y + ee * z) / determinant,
        (cc * x + ee * y + ff * z) / determinant,
        aa / determinant,
    )


@njit(cache=True, nogil=True, error_model='numpy')
def first_plane(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    nearest: NDArray[np.int64],
    errors: tuple[float, float],
    least: float,
) -> tuple[float, float, float]:
    """Plane (a, b, c) of the nearest cells, robust, beginning with the stated one.

    Parameters
    ----------
    place : (3, rows, columns) float64
        Heights are above the stated ground.
    variance : (rows, columns) float64
    nearest : (columns,) int64
        Row of the nearest cell of each column; -1 for none.
    errors : (float, float)
        Standard deviations of the stated height, metres, and of the slope.
    least : float
        The least step, metres.
    """
    a = b = c = 0.0
    total = np.empty(9)
    for _ in range(8):
        total[:] = 0
        for k in range(len(nearest)):
            i = nearest[k]
            if i < 0:
                continue
            x, y, h = place[1, i, k], place[2, i, k], place[0, i, k]
            # Geman and McClure's weights: those of another surface vanish.
            off = 1 + (2 * (h - a - b * x - c * y) / least) ** 2
            add_point(total, x, y, h, 1 / (variance[i, k] + (least / 4) ** 2) / (off * off))
        # What they err by, they have in common: as many as tell a plane.
        total *= SAMPLES / len(nearest)
        a, b, c, _ = solve(total, errors[0] ** -2.0, errors[1] ** -2.0, (0.0, 0.0, 0.0))
    return a, b, c


@njit(cache=True, inline='always')
def add_point(total: NDArray[np.float64], x: float, y: float, h: float, w: float) -> None:
    """Add a point of weight w to the sums of `solve`."""
    entries = (w, w * x, w * y, w * x * x, w * x * y, w * y * y, w * h, w * x * h, w * y * h)
    for n in range(9):
        total[n] += entries[n]


def continued(
    place: NDArray[np.float64],
    variance: NDArray[np.float64],
    height_sd: float,
    slope: float,
    least: float,
) -> Continuation:
    """The ground seen, continued to below the camera by the scale at which it agrees best.

    Parameters
    ----------
    place : (3, N) float64
        Of the cells of the ground: heights above the stated ground, metres. At least one.
    variance : (N,) float64
        Of a cell's height, if all that errs alike were one measurement, metres^2.
    height_sd : float
        Standard deviation of the stated height, metres.
    slope : float
        Tangent of the steepest ground.
    least : float
        The least step, metres.
    """
    h, x, y = place
    distance = np.hypot(x, y)
    start = float(np.partition(distance, len(distance) // 100)[len(distance) // 100])
    size = float(max(np.ptp(x), np.ptp(y)))
    best = None
    for way in _WAYS:
        near = distance <= start + way
        u, v, w = x[near], y[near], 1 / variance[near]
        z = h[near]
        terms = np.array([np.ones(len(u)), u, v, u * u, u * v, v * v, z, u * z, v * z])
        a, b, c, square = solve((terms * w).sum(axis=1), 1e-6, (2 / slope) ** 2, (0.0, 0.0, 0.0))
        # What the ground is off its plane goes on unseen: it tells two points, a way apart.
        residual = z - a - b * u - c * v
        bent = (1 + 2 * start / way) * math.sqrt(float((w * residual**2).sum()) / w.sum())
        sd = math.sqrt(height_sd**2 + square + bent**2)
        if best is None or no_step(a, sd, least) > best.confidence:
            best = Continuation((a, b, c), sd, no_step(a, sd, least), size)
    assert best is not None
    return best
