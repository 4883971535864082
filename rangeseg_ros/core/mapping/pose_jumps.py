"""Whether a pose that was told contradicts the map: its innovation, tested by chi-squared."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.observations import Observations, PoseNoise
from rangeseg_ros.core.mapping.plane_filter import PlaneFilters
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import rotation_by
from rangeseg_ros.core.significance import chi2_quantile
from rangeseg_ros.core.tracking.plane_errors import congruent, mahalanobis

_ROUNDS = 5  # until the motion and the weights settle
# Inverse variance of jumps beforehand, in every direction: of a hundred times the noise of poses.
_PRIOR = 1e-4
_GATE = chi2_quantile(6)


class Jump(NamedTuple):
    """What the fixed frame has moved by against the planes.

    `motion` leads from the fixed frame as it was to what it is; `error` (6,) is that motion as a
    turn about where the `camera` (3,) was told to be, radians, and a shift, metres. Its covariance
    is large in directions that the planes do not tell.
    """

    motion: Transform
    camera: NDArray[np.float64]
    error: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def __str__(self) -> str:
        turn, shift = np.linalg.norm(self.error.reshape(2, 3), axis=1)
        return (
            f'the planes contradict the pose by {1e3 * shift:.0f} mm and '
            f'{np.degrees(turn):.1f} degrees'
        )

    def of(self, known: PlaneFilters) -> PlaneFilters:
        """Planes of the map after the jump, with its error."""
        planes = known.planes.moved(self.motion)
        by_jump = congruent(planes.by_motion(self.camera), self.covariance)
        return known._replace(planes=planes, covariance=known.covariance + by_jump)


def find_jump(
    known: PlaneFilters, seen: Observations, camera: NDArray[np.float64], noise: PoseNoise
) -> Jump | None:
    """Test the pose of a frame by K planes of the map that it shows, in the same order.

    A pose that errs by s, in standard deviations, shows each plane off by z = -B s + v. With
    L = sum B^T R^-1 B the estimate of s has the covariance L^-1 + I, so that s^T L (L + I)^-1 s
    is chi-squared with six degrees of freedom: None where it is chance. Planes that move by
    themselves have less weight (Cauchy). `camera` (3,) is where the pose that was told has it.
    """
    deviations = np.repeat([noise.turn, noise.shift], 3)
    motion, error, weight = Transform.identity(), np.zeros(6), np.ones(len(seen.view))
    for _ in range(_ROUNDS):
        gap, turned = known.planes.moved(motion).apart(seen.planes)
        root = turned @ seen.by_pose
        spread = known.covariance + congruent(turned, seen.covariance)
        weighted = weight[:, None, None] * np.linalg.solve(spread, root)
        information = np.einsum('kia,kib->ab', weighted, root)
        right = np.einsum('kia,ki->a', weighted, gap) + _PRIOR * error
        change = -np.linalg.solve(information + _PRIOR * np.eye(6), right)
        weight = 1 / (1 + mahalanobis(gap + root @ change, spread) / 4)
        error = error + change
        if error @ np.linalg.solve(information + np.eye(6), information @ error) < _GATE:
            return None
        turn, shift = np.split(error * deviations, 2)
        rotation = rotation_by(turn)
        motion = Transform(rotation, camera + shift - rotation @ camera)
    covariance = np.linalg.inv(information + _PRIOR * np.eye(6)) + np.eye(6)
    scaled = np.outer(deviations, deviations) * covariance
    return Jump(motion, camera, error * deviations, scaled)
