r"""The camera's own motion from the planes in sight, with what they leave open.

An extended Kalman filter of the camera and the planes it sees (Smith, Self and Cheeseman,
"Estimating uncertain spatial relationships in robotics", 1990, with planes as landmarks). Its
state has the errors of

* the pose: a turn theta in the camera's axes, true rotation = R exp([theta]x), and a shift;
* the velocity in the camera's axes, turning and going (`camera_motion`): where planes hold the
  camera it is measured, and where they do not, it makes the covariance of the pose grow without
  bound;
* each plane: x of `plane_errors`, and beta of `observations`, which is considered, not estimated,
  as in `plane_filter`.

A plane (n, p) is to be seen in the camera's frame with n' = R^T n and p' = R^T (p - t), so that an
observation is, as error of that plane with the axes e1', e2',

    (a - e2' theta, b + e1' theta, c + n shift + (p' x n') theta) + B beta + v.

Nothing holds what the pose and all planes have in common, so the error of the pose grows with
every plane that goes and every new one that comes. Planes out of sight are forgotten: found again,
they would move the pose at once, and odometry never jumps (REP 105).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.camera_motion import predict
from rangeseg_ros.core.mapping.observations import (
    Observations,
    PoseNoise,
    observations,
    persistence,
)
from rangeseg_ros.core.mapping.plane_errors import cross_matrices, shifted, tangents, to_errors
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import rotation_by
from rangeseg_ros.core.significance import chi2_quantile
from rangeseg_ros.core.tracking.tracker import NOMINAL

# Planes that count, the largest in the image: with 16 the motion is no better, and less is known
# of how it errs, as small regions are seldom what they seem.
_PLANES = 8
# Chi-squared with three degrees of freedom: what is farther off counts less, and is another plane
# from then on.
_GATE = chi2_quantile(3)
_ROUNDS = 3
# Errors of the pose and of the velocity come first in the state, then six of each plane.
_CAMERA, _OWN = 12, 6


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
        moved[:3, 3:], own[:3, 3:] = cross_matrices(np.stack([turn @ place, place]))
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
        self._covariance = np.diag(np.repeat([0.0, 0.0, *np.square(self._spread)], 3))

    @property
    def _spread(self) -> tuple[float, float]:
        """Of the velocity, see `predict`."""
        return float(np.radians(self.config.camera_turn)), self.config.camera_speed

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
        self._update(seen, np.array([order[number] for number in self._id.tolist()], np.intp))
        held = len(self._id)
        new = np.flatnonzero(~np.isin(ids, self._id))
        self._append(Observations(*(part[new] for part in seen)), ids[new])
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
        """Go on with the velocity."""
        assert self._pose is not None
        self._pose, self._velocity, change, noise = predict(
            self._pose, self._velocity, self._spread, elapsed
        )
        self._covariance[:_CAMERA] = change @ self._covariance[:_CAMERA]
        self._covariance[:, :_CAMERA] = self._covariance[:, :_CAMERA] @ change.T
        self._covariance[:_CAMERA, :_CAMERA] += noise

    def _update(self, seen: Observations, which: NDArray[np.intp]) -> None:
        """Take in observations `which` (N,) of the planes; those that do not fit are forgotten."""
        if not len(which):
            return
        design, fresh, gap = self._innovations(seen, which)
        expected = design @ self._covariance
        own = np.einsum('kid,kjd->kij', expected, design) + fresh
        fits = _chi_squared(gap, own) < _GATE
        count, size = int(fits.sum()), len(self._covariance)
        if count:
            fresh = fresh[fits]
            flat, expected = (part[fits].reshape(-1, size) for part in (design, expected))
            gap = gap[fits].ravel()
            spread = expected @ flat.T
            weight = value = np.ones(count)
            # Huber's weights: planes that move by themselves are not to move the camera.
            for _ in range(_ROUNDS):
                noise = _diagonal(fresh / weight[:, None, None])
                # What the state leaves of the gaps.
                rest = noise @ np.linalg.solve(spread + noise, gap)
                value = _chi_squared(rest.reshape(count, 3), fresh)
                weight = np.minimum(1.0, np.sqrt(_GATE / np.maximum(value, 1e-12)))
            noise = _diagonal(fresh / weight[:, None, None])
            gain = np.linalg.solve(spread + noise, expected).T.copy()
            gain[_betas(len(self._id))] = 0
            left = np.eye(size) - gain @ flat
            covariance = left @ self._covariance @ left.T + gain @ noise @ gain.T
            self._covariance = (covariance + covariance.T) / 2
            self._correct(gain @ gap)
            fits[fits] = value < _GATE
        self._keep(fits)

    def _innovations(
        self, seen: Observations, which: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Derivatives (N, 3, D), covariances of v (N, 3, 3), and what is not expected (N, 3)."""
        rho, new = persistence(self._view, seen.view[which])
        self._fade(rho)
        self._view = np.where(rho[:, None] < 1, seen.view[which], self._view)
        design, local = self._design()
        lasting = local @ seen.lasting[which]
        fresh = local @ seen.fresh[which] @ local.transpose(0, 2, 1)
        fresh = fresh + new[:, None, None] * lasting @ lasting.transpose(0, 2, 1)
        gap = local @ seen.plane[which][..., None]
        for k in range(len(which)):
            x = _CAMERA + _OWN * k
            design[k, :, x : x + 3] = np.eye(3)
            design[k, :, x + 3 : x + 6] = lasting[k]
        return design, fresh, gap[..., 0]

    def _design(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Derivatives (N, 3, D) of observations by the pose, and planes (N, 3, 4) to errors."""
        assert self._pose is not None
        turn, shift = self._pose
        axes, normal = self._axes @ turn, self._normal @ turn
        point = (self._point - shift) @ turn
        design = np.zeros((len(normal), 3, len(self._covariance)))
        design[:, 0, :3], design[:, 1, :3] = -axes[:, 1], axes[:, 0]
        design[:, 2, :3] = np.cross(point, normal)
        design[:, 2, 3:6] = self._normal
        return design, to_errors(axes, point)

    def _correct(self, step: NDArray[np.float64]) -> None:
        """Take the estimated errors off the state."""
        assert self._pose is not None
        turn, shift = self._pose
        twist = rotation_by(step[:3])
        self._pose = Transform(turn @ twist, shift + step[3:6])
        self._velocity = self._velocity + step[6:12]
        own = step[_CAMERA:].reshape(-1, _OWN)[:, :3]
        planes = shifted(self._normal, self._point, self._axes, own)
        self._normal, self._point, self._axes = planes

    def _fade(self, rho: NDArray[np.float64]) -> None:
        """Beta of other pixels is partly another one."""
        scale = np.ones(len(self._covariance))
        beta = _betas(len(rho))
        scale[beta] = np.repeat(rho, 3)
        self._covariance = self._covariance * scale[:, None] * scale
        self._covariance[beta, beta] += np.repeat(1 - rho**2, 3)

    def _append(self, seen: Observations, ids: NDArray[np.int64]) -> None:
        """Planes seen for the first time: x = -(what the pose errs by) - B beta - v."""
        assert self._pose is not None
        turn, shift = self._pose
        count, before = len(ids), len(self._covariance)
        normal = seen.plane[:, :3]
        gap = (normal * seen.centroid).sum(axis=1) + seen.plane[:, 3]
        axes, point = tangents(normal), seen.centroid - gap[:, None] * normal
        normal, axes, point = normal @ turn.T, axes @ turn.T, point @ turn.T + shift
        old = len(self._id)
        self._id = np.concatenate([self._id, ids])
        self._normal = np.concatenate([self._normal, normal])
        self._point = np.concatenate([self._point, point])
        self._axes = np.concatenate([self._axes, axes])
        self._view = np.concatenate([self._view.reshape(old, seen.view.shape[1]), seen.view])
        design, local = self._design()
        design, local = design[old:], local[old:]
        lasting = local @ seen.lasting
        fresh = local @ seen.fresh @ local.transpose(0, 2, 1)
        change = np.eye(before + _OWN * count, before)
        noise = np.zeros((len(change), len(change)))
        for k in range(count):
            x = slice(before + _OWN * k, before + _OWN * k + 3)
            beta = slice(x.stop, x.stop + 3)
            change[x] = -design[k]
            noise[x, x] = fresh[k] + lasting[k] @ lasting[k].T
            noise[x, beta], noise[beta, x], noise[beta, beta] = (
                -lasting[k],
                -lasting[k].T,
                np.eye(3),
            )
        self._covariance = change @ self._covariance @ change.T + noise

    def _keep(self, chosen: NDArray[np.bool_]) -> None:
        """Forget the other planes."""
        if chosen.all():
            return
        states = np.concatenate([np.ones(_CAMERA, bool), np.repeat(chosen, _OWN)])
        self._covariance = self._covariance[np.ix_(states, states)]
        for name in ('_id', '_normal', '_point', '_axes', '_view'):
            setattr(self, name, getattr(self, name)[chosen])


def _betas(count: int) -> NDArray[np.intp]:
    """Places of the beta of each of `count` planes in the state."""
    places = _CAMERA + _OWN * np.arange(count)[:, None] + np.arange(3, _OWN)
    return np.asarray(places.ravel(), np.intp)


def _level(up: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation from a camera that sees `up` to x forward and z up."""
    up = up / np.linalg.norm(up)
    # Straight up or down, forward is where the top of the image is.
    _, down, ahead = axes.T
    ahead = ahead if abs(up @ ahead) < 0.99 else -down
    forward = ahead - (ahead @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


def _chi_squared(gap: NDArray[np.float64], spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) of `gap` (N, 3) with covariances (N, 3, 3)."""
    value: NDArray[np.float64]
    value = (gap * np.linalg.solve(spread, gap[..., None])[..., 0]).sum(axis=1)
    return value


def _diagonal(blocks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (3 N, 3 N) with `blocks` (N, 3, 3) along its diagonal."""
    count = len(blocks)
    result = np.zeros((count, 3, count, 3))
    k = np.arange(count)
    result[k, :, k] = blocks
    return result.reshape(3 * count, 3 * count)
