r"""The camera's own motion from the planes in sight, with what they leave open.

An extended Kalman filter of the camera and the planes it sees (Smith, Self and Cheeseman,
"Estimating uncertain spatial relationships in robotics", 1990, with planes as landmarks). Its
state has the errors of

* the pose: a turn theta in the camera's axes, true rotation = R exp([theta]x), and a shift;
* the velocity in the camera's axes, turning and going: an Ornstein-Uhlenbeck process (Uhlenbeck
  and Ornstein, "On the theory of the Brownian motion", 1930). Where planes hold the camera it is
  measured, and where they do not, it makes the covariance of the pose grow without bound;
* the pose of the frame before, which the points at jump edges tell the motion from;
* each plane, as the sensor shows it: x of `plane_errors`. The error that lasts is a part of the
  landmark, which changes as much as the plane comes to be seen by other pixels.

A plane (n, p) is to be seen in the camera's frame with n' = R^T n and p' = R^T (p - t), so that an
observation is, as error of that plane with the axes e1', e2',

    (a - e2' theta, b + e1' theta, c + n shift + (p' x n') theta) + v.

Nothing measures the error that the pose and all planes have in common: that of the pose grows with
every plane that goes and every new one that comes. Planes out of sight are forgotten: found again,
they would move the pose at once, and odometry never jumps (REP 105).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from rangeseg_ros.core.arrays import Floats, Mask
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.edges import JumpPoints
from rangeseg_ros.core.mapping.observations import (
    LASTING,
    Observations,
    PlaneSet,
    PoseNoise,
    continuity,
    observations,
)
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import cross_matrix, rotation_by
from rangeseg_ros.core.tracking.plane_errors import GATE, congruent, mahalanobis
from rangeseg_ros.core.tracking.tracker import NOMINAL, PERSISTENCE

# Number of planes used, the largest in the image: 16 give no better motion but a less reliable
# covariance, as small regions are often not planes.
_PLANES = 8
_ROUNDS = 4
# Errors of pose, velocity and the pose before come first in the state, then three of each plane.
_CAMERA = 18
_POSES = np.r_[:6, 12:18]
_NO_EDGES = JumpPoints(np.zeros((0, 3)), 0.0)


class Motion(NamedTuple):
    """Where the camera is and how it moves.

    The pose takes the frame of the image to that of the odometry, `frame`: x forward where the
    camera looked first, z up, its origin where the camera was then. Its covariance (6, 6) is of
    the shift, then the turn about the fixed axes, metres and radians. The velocity (6,), metres
    per second, then radians per second, is in the frame of the image. `held` is the number of
    planes that tell how the camera moved since the frame before.
    """

    frame: str
    pose: Transform
    covariance: Floats
    velocity: Floats
    velocity_covariance: Floats
    held: int

    def of_origin(self, place: Floats) -> Motion:
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

    Of the parameters, `odometry_frame`, `camera_turn` and `camera_speed` count.

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
        self._planes = PlaneSet.of([])
        self._view = np.zeros((0, 0))
        self._edges, self._before = _NO_EDGES, Transform.identity()
        self._covariance = np.diag(np.concatenate([np.zeros(6), self._spread**2, np.zeros(6)]))

    @property
    def _spread(self) -> Floats:
        """(6,) standard deviations of the velocity: radians, then metres per second."""
        return np.repeat([np.radians(self.config.camera_turn), self.config.camera_speed], 3)

    def add(
        self,
        planes: Sequence[Plane],
        view: Floats,
        stamp: int,
        up: ArrayLike,
        axes: ArrayLike = ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        edges: JumpPoints = _NO_EDGES,
    ) -> Motion:
        """Take in the planes of the next frame, tracked, with their `views`.

        When stamps, nanoseconds, do not tell, as much time as is common has passed. Of the first
        frame, `up` (3,) counts, and the `axes` (3, 3) that are right, down and forward in the
        image, both in the frame of the image as the planes are. `edges` are the ends of what is in
        sight.
        """
        pose = self._pose or Transform(level(np.array(up, float), np.array(axes)), np.zeros(3))
        if self._pose:
            elapsed = (stamp - self._stamp) * 1e-9 if stamp > self._stamp > 0 else NOMINAL
            pose = self._predict(pose, elapsed)
        self._stamp = stamp
        largest = np.argsort([-plane.count for plane in planes], kind='stable')[:_PLANES]
        chosen = [planes[k] for k in largest]
        seen = observations(chosen, view[largest], Transform.identity(), PoseNoise(0.0, 0.0))
        ids = np.array([plane.id for plane in chosen], np.int64)
        self._keep(np.isin(self._id, ids))
        if len(self._id):
            order = {number: m for m, number in enumerate(ids.tolist())}
            pose = self._update(pose, seen.where([order[own] for own in self._id.tolist()]))
        pose = self._align(pose, edges)
        held, new = len(self._id), ~np.isin(ids, self._id)
        self._append(pose, seen.where(new), ids[new])
        self._pose = pose
        swap = np.zeros((6, 6))
        swap[:3, 3:], swap[3:, :3] = np.eye(3), pose.rotation
        # Velocities: turning and going change places only.
        places = np.r_[9:12, 6:9]
        return Motion(
            self.config.odometry_frame,
            pose,
            swap @ self._covariance[:6, :6] @ swap.T,
            np.roll(self._velocity, 3),
            self._covariance[np.ix_(places, places)],
            held,
        )

    def _predict(self, pose: Transform, elapsed: float) -> Transform:
        """Go on with the velocity, which fades."""
        turn, shift = pose
        part = elapsed / PERSISTENCE
        kept, reach = np.exp(-part), PERSISTENCE * -np.expm1(-part)
        twist, going = rotation_by(reach * self._velocity[:3]), self._velocity[3:]
        change = np.eye(len(self._covariance))
        change[:3, :3] = twist.T
        change[3:6, :3] = -reach * turn @ cross_matrix(going)
        # From the velocity to the pose: the turn is in the camera's axes, the shift is not.
        outwards = block_diag(np.eye(3), turn)
        change[:6, 6:12] = reach * outwards
        change[6:12, 6:12] *= kept
        change[12:_CAMERA] = np.eye(6, len(change))
        # Of the path and the velocity, for unit variance; the axes are alike, so that no rotation
        # counts.
        path = PERSISTENCE**2 * (2 * part - 3 + 4 * kept - kept**2)
        both, speed = PERSISTENCE * (1 - kept) ** 2 * outwards, 1 - kept**2
        variance = np.diag(self._spread**2)
        self._covariance = change @ self._covariance @ change.T
        self._covariance[:12, :12] += np.block(
            [[path * variance, both @ variance], [variance @ both.T, speed * variance]]
        )
        self._velocity, self._before = kept * self._velocity, pose
        return Transform(turn @ twist, shift + reach * turn @ going)

    def _update(self, pose: Transform, seen: Observations) -> Transform:
        """Take in observations of all planes; those that do not fit are forgotten."""
        there = self._planes.moved(pose.inverse())
        gap, turned = there.apart(seen.planes)
        error = congruent(turned, seen.covariance)
        # Planes seen by other pixels show another part of the error that lasts.
        same = continuity(self._view, seen.view)
        change = (2 * (1 - same) * LASTING)[:, None, None] * error
        self._covariance[_CAMERA:, _CAMERA:] += block_diag(*change)
        self._view[same < 1] = seen.view[same < 1]
        noise, own = (1 - LASTING) * error, np.eye(3 * len(gap)).reshape(len(gap), 3, -1)
        design = np.concatenate([_by_camera(there, pose), own], axis=2)
        fits = mahalanobis(gap, congruent(design, self._covariance) + noise) < GATE
        if fits.any():
            flat, gap, noise = np.concatenate(design[fits]), gap[fits], noise[fits]
            expected = flat @ self._covariance
            weight = value = np.ones(len(gap))
            # Cauchy's weights: planes that move by themselves are not to move the camera.
            for _ in range(_ROUNDS):
                error = block_diag(*(noise / weight[:, None, None]))
                gain = np.linalg.solve(expected @ flat.T + error, expected).T
                step = gain @ gap.ravel()
                # What the state leaves of the gaps.
                value = mahalanobis(gap - (flat @ step).reshape(-1, 3), noise)
                weight = 1 / (1 + value / 4)
            pose = self._corrected(pose, step, gain, flat, error)
            fits[fits] = value < GATE
        self._keep(fits)
        return pose

    def _align(self, pose: Transform, edges: JumpPoints) -> Transform:
        """Take in where the edges of the frame before are now."""
        last, self._edges = self._edges, edges
        prior = self._covariance[np.ix_(_POSES, _POSES)]
        jacobian, values = edges.motion(last, self._before, pose, prior)
        design, noise = np.zeros((len(values), len(self._covariance))), np.eye(len(values))
        design[:, _POSES] = jacobian
        expected = design @ self._covariance
        gain = np.linalg.solve(expected @ design.T + noise, expected).T
        return self._corrected(pose, gain @ values, gain, design, noise)

    def _corrected(
        self, pose: Transform, step: Floats, gain: Floats, design: Floats, noise: Floats
    ) -> Transform:
        """The pose without the errors `step` that measurements show; in place the rest."""
        left = np.eye(len(gain)) - gain @ design
        covariance = left @ self._covariance @ left.T + gain @ noise @ gain.T
        self._covariance = (covariance + covariance.T) / 2
        self._velocity = self._velocity + step[6:12]
        self._before = self._before.by(step[12:_CAMERA])
        self._planes = self._planes.without(step[_CAMERA:].reshape(-1, 3))
        return pose.by(step[:6])

    def _append(self, pose: Transform, seen: Observations, ids: NDArray[np.int64]) -> None:
        """Planes seen for the first time: x = -(what the pose errs by) - v."""
        self._view = np.concatenate(
            [self._view.reshape(len(self._id), seen.view.shape[1]), seen.view]
        )
        self._id = np.concatenate([self._id, ids])
        self._planes = self._planes.joined(seen.planes.moved(pose))
        before = len(self._covariance)
        change = np.eye(before + 3 * len(ids), before)
        change[before:, :_CAMERA] = -_by_camera(seen.planes, pose).reshape(-1, _CAMERA)
        self._covariance = change @ self._covariance @ change.T
        fresh = block_diag(*((1 - LASTING) * seen.covariance))
        self._covariance[before:, before:] += fresh

    def _keep(self, chosen: Mask) -> None:
        """Forget the other planes."""
        states = np.concatenate([np.ones(_CAMERA, bool), np.repeat(chosen, 3)])
        self._covariance = self._covariance[np.ix_(states, states)]
        self._planes = self._planes.where(chosen)
        self._id, self._view = self._id[chosen], self._view[chosen]


def _by_camera(planes: PlaneSet, pose: Transform) -> Floats:
    """(N, 3, 18) derivatives of planes (N,) that a camera sees by its pose; 0 by the rest."""
    design = np.zeros((len(planes.normal), 3, _CAMERA))
    design[:, :, :6] = planes.by_motion(np.zeros(3))
    # The shift is in the fixed frame.
    design[:, 2, 3:6] = planes.normal @ pose.rotation.T
    return design


def level(up: Floats, axes: Floats) -> Floats:
    """Rotation from a camera that sees `up` to x forward and z up."""
    up = up / np.linalg.norm(up)
    # Straight up or down, forward is where the top of the image is.
    _, down, ahead = axes.T
    ahead = ahead if abs(up @ ahead) < 0.99 else -down
    forward = ahead - (ahead @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])
