"""How a camera goes on that a hand or a robot carries: a velocity that persists for a while.

An Ornstein-Uhlenbeck process (Uhlenbeck and Ornstein, "On the theory of the Brownian motion",
1930) with the spread of what cameras commonly do. The error of its state is that of `odometry`: a
turn in the camera's axes, a shift, and the velocity in the camera's axes, turning and going.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.plane_errors import cross_matrices
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import rotation_by
from rangeseg_ros.core.tracking.tracker import PERSISTENCE


class Prediction(NamedTuple):
    """Where a camera is after a while, when nothing is seen.

    Attributes
    ----------
    pose : Transform
    velocity : (6,) float64
    change, noise : (12, 12) float64
        The errors are `change` times those before, and have the covariance `noise` more.
    """

    pose: Transform
    velocity: NDArray[np.float64]
    change: NDArray[np.float64]
    noise: NDArray[np.float64]


def predict(
    pose: Transform,
    velocity: NDArray[np.float64],
    spread: tuple[float, float],
    elapsed: float,
) -> Prediction:
    """Go on with a velocity, which fades.

    Parameters
    ----------
    pose : Transform
        From the frame of the image.
    velocity : (6,) float64
        In that frame: radians per second, then metres per second.
    spread : (float, float)
        Standard deviations of the velocity: radians per second, metres per second.
    elapsed : float
        Seconds.
    """
    turn, shift = pose
    part = elapsed / PERSISTENCE
    kept, reach = np.exp(-part), PERSISTENCE * -np.expm1(-part)
    turned = rotation_by(reach * velocity[:3])
    change = np.eye(12)
    change[:3, :3] = turned.T
    change[:3, 6:9] = reach * np.eye(3)
    change[3:6, :3] = -reach * turn @ cross_matrices(velocity[None, 3:])[0]
    change[3:6, 9:] = reach * turn
    change[6:, 6:] *= kept
    # Of the path and the velocity, for unit variance; the axes are alike, so that no rotation
    # counts.
    path = PERSISTENCE**2 * (2 * part - 3 + 4 * kept - kept**2)
    both, speed = PERSISTENCE * (1 - kept) ** 2, 1 - kept**2
    turning, going = np.square(spread)
    variance = np.diag(np.repeat([turning, going], 3))
    across = np.zeros((6, 6))
    across[:3, :3], across[3:, 3:] = turning * np.eye(3), going * turn
    noise = np.block([[path * variance, both * across], [both * across.T, speed * variance]])
    moved = turn @ (reach * velocity[3:]) + shift
    return Prediction(Transform(turn @ turned, moved), kept * velocity, change, noise)
