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

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.config import Config

# Metres of ground, from where it begins, that are continued to below the camera: each doubles the
# one before. A short one is right where a ramp begins, a long one where the ground undulates.
_WAYS = (0.4, 0.8, 1.6, 3.2)
# Prior probability of a step out of view between the robot and the ground it sees, and the height
# of the highest one, metres.
STEP_PRIOR, HIGHEST_STEP = 0.1, 0.35


class Stand(NamedTuple):
    """Where a robot stands.

    The plane of the ground under it, theta . ray = inverse range, zeros where it is not known; the
    probability that the ground seen is the one it stands on; and what contradicts, in words.
    """

    theta: Floats
    confidence: float
    reasons: tuple[str, ...] = ()

    @property
    def found(self) -> bool:
        """Whether the ground is known."""
        return bool(self.theta.any())

    def height(self, up: Floats) -> float:
        """Of the sensor above the ground below it, along `up`, metres; NaN without a ground."""
        return float(-1 / (self.theta @ up)) if self.found else float('nan')


class Continuation(NamedTuple):
    """The ground that is seen, continued to below the camera, against the one that is stated.

    `plane` is (a, b, c), `error` the standard deviation of a, that of the stated height included,
    metres, and `confidence` the probability that there is no step out of view.
    """

    plane: tuple[float, float, float]
    error: float
    confidence: float


def no_step(a: float, sd: float, least: float) -> float:
    """Probability that ground `a` metres off the stated one, +- `sd`, is no step of `least`.

    By Bayes' rule: a share `STEP_PRIOR` of grounds lies behind a step, uniform to `HIGHEST_STEP`.
    """
    same = (1 - STEP_PRIOR) * math.exp(-((a / sd) ** 2) / 2) / (sd * math.sqrt(2 * math.pi))
    tails = sum(math.erfc((least - side * a) / (sd * math.sqrt(2))) / 2 for side in (-1, 1))
    step = STEP_PRIOR * tails / (2 * max(HIGHEST_STEP - least, least))
    return same / (same + step) if same > 0 else 0.0


def continued(place: Floats, variance: Floats, height_sd: float, config: Config) -> Continuation:
    """The ground seen, continued to below the camera by the scale at which it agrees best.

    `place` (3, N) of cells of the ground is height above the stated ground and horizontal
    position, metres, `variance` (N,) that of a height, and `height_sd` the standard deviation of
    the stated height. At least one cell.
    """
    h, x, y = place
    distance = np.hypot(x, y)
    start = float(np.partition(distance, len(distance) // 100)[len(distance) // 100])
    terms = np.stack([np.ones(len(x)), x, y, h])
    weighted = terms / (4 * variance)  # of a height, if all that errs alike were one measurement
    # The ground is level where it does not show its slope.
    prior = np.diag([1e-6, *2 * [4 / max(config.steepest, 1e-3) ** 2]])
    found = []
    for way in _WAYS:
        sums = (weighted * (distance <= start + way)) @ terms.T
        covariance = np.linalg.inv(sums[:3, :3] + prior)
        plane = covariance @ sums[:3, 3]
        # What the ground is off its plane goes on unseen: it tells two points, a way apart.
        off = np.append(-plane, 1)
        bent = (1 + 2 * start / way) * math.sqrt(max(off @ sums @ off, 0) / sums[0, 0])
        sd = math.sqrt(height_sd**2 + covariance[0, 0] + bent**2)
        a, b, c = map(float, plane)
        found.append(Continuation((a, b, c), sd, no_step(a, sd, config.least_step)))
    return max(found, key=lambda one: one.confidence)
