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
from rangeseg_ros.core.tracking.plane_errors import congruent, mahalanobis, to_errors

_ROUNDS = 5  # until the motion and the weights settle
# Inverse variance of jumps beforehand, in every direction: of a hundred times the noise of poses.
_PRIOR = 1e-4
_GATE = chi2_quantile(6)


class Jump(NamedTuple):
    """What the fixed frame has moved by against the planes.

    Attributes
    ----------
    motion : Transform
        Of the fixed frame as it was to what it is.
    camera : (3,) float64
        Where the camera was told to be.
    error : (6,) float64
        The motion as a turn about the camera, radians, and a shift, metres.
    covariance : (6, 6) float64
        Of the error: large in directions that the planes do not tell.
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


def find_jump(
    known: PlaneFilters, seen: Observations, camera: NDArray[np.float64], noise: PoseNoise
) -> Jump | None:
    """Test the pose of a frame by the planes that it shows.

    Parameters
    ----------
    known : PlaneFilters
        K planes of the map.
    seen : Observations
        The same planes as the frame shows them.
    camera : (3,) float64
        Where the camera is by the pose that was told.
    noise : PoseNoise

    Returns
    -------
    Jump or None
        None where what the pose differs by is chance (chi-squared, six degrees of freedom).

    Notes
    -----
    A pose that errs by s, in standard deviations, shows each plane off by z = -B s + v. With
    L = sum B^T R^-1 B the estimate of s has the covariance L^-1 + I, so that s^T L (L + I)^-1 s
    is chi-squared. Planes that move by themselves have less weight (Cauchy).
    """
    deviations = np.repeat([noise.turn, noise.shift], 3)
    every, weight = np.arange(len(known.normal)), np.ones(len(known.normal))
    motion, error = Transform.identity(), np.zeros(6)
    for _ in range(_ROUNDS):
        moved = known.moved(motion)
        step = moved.expected(every, seen, every)
        root = to_errors(moved.axes, moved.point) @ seen.by_pose
        spread = step.spread - congruent(root, np.eye(6))
        weighted = weight[:, None, None] * np.linalg.solve(spread, root)
        information = np.einsum('kia,kib->ab', weighted, root)
        right = np.einsum('kia,ki->a', weighted, step.gap) + _PRIOR * error
        change = -np.linalg.solve(information + _PRIOR * np.eye(6), right)
        weight = 1 / (1 + mahalanobis(step.gap + root @ change, spread) / 4)
        error = error + change
        if error @ np.linalg.solve(information + np.eye(6), information @ error) < _GATE:
            return None
        turn, shift = np.split(error * deviations, 2)
        rotation = rotation_by(turn)
        motion = Transform(rotation, camera + shift - rotation @ camera)
    covariance = np.linalg.inv(information + _PRIOR * np.eye(6)) + np.eye(6)
    scaled = np.outer(deviations, deviations) * covariance
    return Jump(motion, camera, error * deviations, scaled)
