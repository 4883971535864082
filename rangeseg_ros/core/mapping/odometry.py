r"""The camera's own motion from the planes in sight, with what they leave open.

An extended Kalman filter of the camera and the planes it sees (Smith, Self and Cheeseman,
"Estimating uncertain spatial relationships in robotics", 1990, with planes as landmarks). Its
state has the errors of

* the pose: a turn theta in the camera's axes, true rotation = R exp([theta]x), and a shift;
* the velocity in the camera's axes, turning and going: an Ornstein-Uhlenbeck process (Uhlenbeck
  and Ornstein, "On the theory of the Brownian motion", 1930). Where planes hold the camera it is
  measured, and where they do not, it makes the covariance of the pose grow without bound;
* each plane, as the sensor shows it: x of `plane_errors`. The error that lasts is a part of the
  landmark, which changes as much as the plane comes to be seen by other pixels.

A plane (n, p) is to be seen in the camera's frame with n' = R^T n and p' = R^T (p - t), so that an
observation is, as error of that plane with the axes e1', e2',

    (a - e2' theta, b + e1' theta, c + n shift + (p' x n') theta) + v.

Nothing holds what the pose and all planes have in common, so the error of the pose grows with
every plane that goes and every new one that comes. Planes out of sight are forgotten: found again,
they would move the pose at once, and odometry never jumps (REP 105).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.observations import (
    Observations,
    PoseNoise,
    continuity,
    observations,
)
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import cross_matrix, rotation_by
from rangeseg_ros.core.tracking.plane_errors import (
    GATE,
    by_motion,
    congruent,
    mahalanobis,
    shifted,
    to_errors,
)
from rangeseg_ros.core.tracking.tracker import NOMINAL, PERSISTENCE

# Planes that count, the largest in the image: with 16 the motion is no better, and less is known
# of how it errs, as small regions are seldom what they seem.
_PLANES = 8
_ROUNDS = 3
# Errors of the pose and of the velocity come first in the state, then three of each plane.
_CAMERA = 12


class Motion(NamedTuple):
    """Where the camera is and how it moves.

    Attributes
    ----------
    frame : str
        Name of the frame of the odometry: x forward where the camera looked first, z up, its
        origin where the camera was then.
    pose : Transform
        From the frame of the image to that one.
    covariance : (6, 6) float64
        Of the pose: shift, then turn about the fixed axes, metres and radians.
    velocity : (6,) float64
        In the frame of the image: metres per second, then radians per second.
    velocity_covariance : (6, 6) float64
    held : int
        Number of planes that tell how the camera moved since the frame before.
    """

    frame: str
    pose: Transform
    covariance: NDArray[np.float64]
    velocity: NDArray[np.float64]
    velocity_covariance: NDArray[np.float64]
    held: int

    def of_origin(self, place: NDArray[np.float64]) -> Motion:
        """The motion of a camera at `place` (3,), as that of the origin of its frame."""
        turn, shift = self.pose
        # What turns the camera by w moves the origin by w x -place against it.
        moved, own = np.eye(6), np.eye(6)
        moved[:3, 3:], own[:3, 3:] = cross_matrix(turn @ place), cross_matrix(place)
        return self._replace(
            pose=Transform(turn, shift - turn @ place),
            covariance=moved @ self.covariance @ moved.T,
            velocity=own @ self.velocity,
            velocity_covariance=own @ self.velocity_covariance @ own.T,
        )


class PlaneOdometry:
    """Follows a camera by the planes it sees.

    Parameters
    ----------
    config : Config, optional
        `odometry_frame`, `camera_turn` and `camera_speed`.

    Examples
    --------
    >>> odometry = PlaneOdometry(config)
    >>> motion = odometry.add(planes, views(labels, planes, length), stamp, up)
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self._stamp = 0
        self._pose: Transform | None = None
        self._velocity = np.zeros(6)
        self._id = np.zeros(0, np.int64)
        self._normal = self._point = np.zeros((0, 3))
        self._axes = np.zeros((0, 2, 3))
        self._view = np.zeros((0, 0))
        self._covariance = np.diag(np.concatenate([np.zeros(6), self._spread**2]))

    @property
    def _spread(self) -> NDArray[np.float64]:
        """(6,) standard deviations of the velocity: radians, then metres per second."""
        return np.repeat([np.radians(self.config.camera_turn), self.config.camera_speed], 3)

    def add(
        self,
        planes: Sequence[Plane],
        view: NDArray[np.float64],
        stamp: int,
        up: ArrayLike,
        axes: ArrayLike = ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ) -> Motion:
        """Take in the next frame.

        Parameters
        ----------
        planes : sequence of Plane
            In the frame of the image, tracked.
        view : (M, C) float64
            See `views`.
        stamp : int
            Nanoseconds; when it does not tell, as much as is common has passed.
        up : (3,) float
            In the frame of the image; counts for the first one.
        axes : (3, 3) float
            What is right, down and forward in the image; the identity in an optical frame.
        """
        if self._pose is None:
            self._pose = Transform(_level(np.array(up, np.float64), np.array(axes)), np.zeros(3))
        else:
            elapsed = (stamp - self._stamp) * 1e-9 if stamp > self._stamp > 0 else NOMINAL
            self._predict(elapsed)
        self._stamp = stamp
        largest = np.argsort([-plane.count for plane in planes], kind='stable')[:_PLANES]
        chosen = [planes[k] for k in largest]
        still = PoseNoise(0.0, 0.0)
        seen = observations(chosen, view[largest], Transform.identity(), still)
        ids = np.array([plane.id for plane in chosen], np.int64)
        self._keep(np.isin(self._id, ids))
        order = {number: m for m, number in enumerate(ids.tolist())}
        self._update(seen.where([order[number] for number in self._id.tolist()]))
        held = len(self._id)
        new = np.flatnonzero(~np.isin(ids, self._id))
        self._append(seen.where(new), ids[new])
        return self._motion(held)

    def _motion(self, held: int) -> Motion:
        assert self._pose is not None
        swap = np.zeros((6, 6))
        swap[:3, 3:], swap[3:, :3] = np.eye(3), self._pose.rotation
        # Velocities: turning and going change places only.
        places = np.r_[9:12, 6:9]
        return Motion(
            self.config.odometry_frame,
            self._pose,
            swap @ self._covariance[:6, :6] @ swap.T,
            np.roll(self._velocity, 3),
            self._covariance[np.ix_(places, places)],
            held,
        )

    def _predict(self, elapsed: float) -> None:
        """Go on with the velocity, which fades."""
        assert self._pose is not None
        turn, shift = self._pose
        part = elapsed / PERSISTENCE
        kept, reach = np.exp(-part), PERSISTENCE * -np.expm1(-part)
        twist = rotation_by(reach * self._velocity[:3])
        change = np.eye(_CAMERA)
        change[:3, :3] = twist.T
        change[3:6, :3] = -reach * turn @ cross_matrix(self._velocity[3:])
        # From the velocity to the pose: the turn is in the camera's axes, the shift is not.
        outwards = block_diag(np.eye(3), turn)
        change[:6, 6:] = reach * outwards
        change[6:, 6:] *= kept
        # Of the path and the velocity, for unit variance; the axes are alike, so that no rotation
        # counts.
        path = PERSISTENCE**2 * (2 * part - 3 + 4 * kept - kept**2)
        both, speed = PERSISTENCE * (1 - kept) ** 2 * outwards, 1 - kept**2
        variance = np.diag(self._spread**2)
        noise = np.block(
            [[path * variance, both @ variance], [variance @ both.T, speed * variance]]
        )
        self._pose = Transform(turn @ twist, shift + reach * turn @ self._velocity[3:])
        self._velocity = kept * self._velocity
        change = block_diag(change, np.eye(len(self._covariance) - _CAMERA))
        self._covariance = change @ self._covariance @ change.T
        self._covariance[:_CAMERA, :_CAMERA] += noise

    def _update(self, seen: Observations) -> None:
        """Take in observations of all planes; those that do not fit are forgotten."""
        count, size = len(self._id), len(self._covariance)
        if not count:
            return
        design, local = self._design()
        self._change_views(seen, local)
        noise = congruent(local, seen.fresh)
        gap = (local @ seen.plane[..., None])[..., 0]
        spread = congruent(design, self._covariance) + noise
        fits = mahalanobis(gap, spread) < GATE
        if fits.any():
            flat, gap = design[fits].reshape(-1, size), gap[fits]
            noise, expected = noise[fits], flat @ self._covariance
            weight = value = np.ones(len(gap))
            # Huber's weights: planes that move by themselves are not to move the camera.
            for _ in range(_ROUNDS):
                error = block_diag(*(noise / weight[:, None, None]))
                total = expected @ flat.T + error
                # What the state leaves of the gaps.
                rest = error @ np.linalg.solve(total, gap.ravel())
                value = mahalanobis(rest.reshape(-1, 3), noise)
                weight = np.minimum(1.0, np.sqrt(GATE / np.maximum(value, 1e-12)))
            error = block_diag(*(noise / weight[:, None, None]))
            gain = np.linalg.solve(expected @ flat.T + error, expected).T
            left = np.eye(size) - gain @ flat
            covariance = left @ self._covariance @ left.T + gain @ error @ gain.T
            self._covariance = (covariance + covariance.T) / 2
            self._correct(gain @ gap.ravel())
            fits[fits] = value < GATE
        self._keep(fits)

    def _change_views(self, seen: Observations, local: NDArray[np.float64]) -> None:
        """Planes seen by other pixels show another part of the error that lasts."""
        same = continuity(self._view, seen.view)
        change = 2 * (1 - same)[:, None, None] * congruent(local @ seen.lasting, np.eye(3))
        self._covariance[_CAMERA:, _CAMERA:] += block_diag(*change)
        other = same < 1
        self._view[other] = seen.view[other]

    def _design(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Derivatives (N, 3, D) of observations by the state, and planes (N, 3, 4) to errors."""
        assert self._pose is not None
        turn, shift = self._pose
        axes, normal = self._axes @ turn, self._normal @ turn
        point = (self._point - shift) @ turn
        design = np.zeros((len(normal), 3, len(self._covariance)))
        design[:, :, :6] = by_motion(normal, axes, point)
        # The shift is in the fixed frame.
        design[:, 2, 3:6] = self._normal
        for k in range((len(self._covariance) - _CAMERA) // 3):
            at = _CAMERA + 3 * k
            design[k, :, at : at + 3] = np.eye(3)
        return design, to_errors(axes, point)

    def _correct(self, step: NDArray[np.float64]) -> None:
        """Take the estimated errors off the state."""
        assert self._pose is not None
        turn, shift = self._pose
        self._pose = Transform(turn @ rotation_by(step[:3]), shift + step[3:6])
        self._velocity = self._velocity + step[6:12]
        own = step[_CAMERA:].reshape(-1, 3)
        planes = shifted(self._normal, self._point, self._axes, own)
        self._normal, self._point, self._axes = planes

    def _append(self, seen: Observations, ids: NDArray[np.int64]) -> None:
        """Planes seen for the first time: x = -(what the pose errs by) - v."""
        assert self._pose is not None
        turn, shift = self._pose
        old = len(self._id)
        normal, axes, point = seen.tangent_frame()
        self._id = np.concatenate([self._id, ids])
        self._normal = np.concatenate([self._normal, normal @ turn.T])
        self._point = np.concatenate([self._point, point @ turn.T + shift])
        self._axes = np.concatenate([self._axes, axes @ turn.T])
        self._view = np.concatenate([self._view.reshape(old, seen.view.shape[1]), seen.view])
        design, local = (part[old:] for part in self._design())
        before = len(self._covariance)
        change = np.concatenate([np.eye(before), -design.reshape(-1, before)])
        self._covariance = change @ self._covariance @ change.T
        if len(ids):
            self._covariance[before:, before:] += block_diag(*congruent(local, seen.fresh))

    def _keep(self, chosen: NDArray[np.bool_]) -> None:
        """Forget the other planes."""
        if chosen.all():
            return
        states = np.concatenate([np.ones(_CAMERA, bool), np.repeat(chosen, 3)])
        self._covariance = self._covariance[np.ix_(states, states)]
        for name in ('_id', '_normal', '_point', '_axes', '_view'):
            setattr(self, name, getattr(self, name)[chosen])


def _level(up: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation from a camera that sees `up` to x forward and z up."""
    up = up / np.linalg.norm(up)
    # Straight up or down, forward is where the top of the image is.
    _, down, ahead = axes.T
    ahead = ahead if abs(up @ ahead) < 0.99 else -down
    forward = ahead - (ahead @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])
