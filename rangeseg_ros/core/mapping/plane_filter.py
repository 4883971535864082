r"""Planes estimated from many observations: a Kalman filter per plane, all of them at once.

A plane is its unit normal n and a point p on it. Its error is x = (a, b, c): the true normal is
n + a e1 + b e2 with the axes e1, e2 of the tangent space of the unit sphere at n, and the true
plane passes c above p along it. So three numbers are estimated where the plane has three degrees
of freedom, and no covariance is singular.

An observation differs from the plane by z = x + B beta + v. The error of a depth camera is mostly
a pattern that stays in its place in the image, so that looking on at 30 Hz does not make it
smaller: beta, of unit variance, is that part of the error, and lasts from one observation to the
next as much as both were of the same pixels; v is what is new in every frame, that of the camera's
pose too. Both x and beta are estimated (coloured noise by augmentation of the state: Bryson and
Johansen, "Linear filtering for time-varying systems using measurements containing colored
noise", IEEE TAC 1965). Without lasting errors this is the information filter of a constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.fitting.uncertainty import plane_jacobians
from rangeseg_ros.core.mapping.transforms import Transform

# Share of the variance of planes that lasts while the same pixels see them: of the smooth
# distortion, nearly all of the error of a plane, 55 % was found to be one pattern in eight real
# frames of a sequence, and 80 % is one in the simulated sensor.
_LASTING = 0.8
# Overlap in the image from which two observations are of the same pixels, so that small motions to
# and fro do not count as new looks. From 0.5 to 0.85 the map is as good and as sure of itself.
_ANOTHER = 0.7
# What planes differ by from the truth beyond their covariances, as factor of variances, by the
# residue of bands, grazing views and ragged borders: that of `fitting.coplanar`.
_RESIDUE = 2.5
# What parts of one surface differ by beyond their covariances, see `tracking.tracks`: an angle,
# and an offset as share of the range.
_ANGLE, _OFFSET = np.radians(1.0), 0.007


class PoseNoise(NamedTuple):
    """Standard deviations of the pose of a camera: metres and radians, about each axis."""

    shift: float
    turn: float


class Observations(NamedTuple):
    """M planes of a frame in the fixed frame.

    Attributes
    ----------
    plane : (M, 4) float64
        Normal and distance.
    lasting : (M, 4, 3) float64
        Square root of the covariance of the error that lasts, of (normal, distance).
    fresh : (M, 4, 4) float64
        Covariance of the error that is new in this frame.
    centroid : (M, 3) float64
    range : (M,) float64
        Distance of the centroid from the camera, metres.
    view : (M, C) float64
        Unit vectors: how many pixels of each cell of the image the plane had.
    """

    plane: NDArray[np.float64]
    lasting: NDArray[np.float64]
    fresh: NDArray[np.float64]
    centroid: NDArray[np.float64]
    range: NDArray[np.float64]
    view: NDArray[np.float64]


def observations(
    planes: Sequence[Plane], view: NDArray[np.float64], pose: Transform, noise: PoseNoise
) -> Observations:
    """Planes of a frame, with their errors and those of the camera's pose, in the fixed frame."""
    normal = np.array([p.normal for p in planes], np.float64).reshape(-1, 3)
    distance = np.array([p.distance for p in planes], np.float64)
    centroid = np.array([p.centroid for p in planes], np.float64).reshape(-1, 3)
    covariance = np.array([p.covariance for p in planes], np.float64).reshape(-1, 4, 4) * _RESIDUE
    covariance = covariance + _unexplained(planes, normal, centroid)
    turn, shift = pose
    to_world = np.zeros((4, 4))
    to_world[:3, :3], to_world[3, :3], to_world[3, 3] = turn, -shift @ turn, 1
    # In the form theta . ray = 1 / z the pattern of the image is the same at any distance.
    back = np.zeros((len(planes), 3, 4))
    back[:, :, :3] = -np.eye(3) / distance[:, None, None]
    back[:, :, 3] = normal / distance[:, None] ** 2
    theta = back @ covariance @ back.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(theta)
    # The symmetric root, as beta is to mean the same in every frame.
    root = (vectors * np.sqrt(np.maximum(values, 0))[:, None]) @ vectors.transpose(0, 2, 1)
    lasting = to_world @ plane_jacobians(normal, distance) @ root
    square = lasting @ lasting.transpose(0, 2, 1)
    world = normal @ turn.T
    # A turn w of the camera moves normals by w x n; its distance from the plane stays.
    cross = _cross(world)
    by_turn = np.concatenate([-cross, (shift @ cross)[:, None]], axis=1)
    by_shift = np.zeros((len(planes), 4, 3))
    by_shift[:, 3] = -world
    fresh = (1 - _LASTING) * square
    for part, sigma in ((by_turn, noise.turn), (by_shift, noise.shift)):
        fresh = fresh + sigma**2 * part @ part.transpose(0, 2, 1)
    return Observations(
        np.column_stack([world, distance - world @ shift]),
        np.sqrt(_LASTING) * lasting,
        fresh,
        centroid @ turn.T + shift,
        np.linalg.norm(centroid, axis=1),
        view,
    )


def _unexplained(
    planes: Sequence[Plane], normal: NDArray[np.float64], centroid: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariances (M, 4, 4) of planes by what else is in their regions.

    Pixels that a plane does not explain, 1 - confidence of them, are of another surface or a bent
    one, and may shift and tilt it by their share of the residual.
    """
    share = np.array([(1 - p.confidence) * p.rms**2 for p in planes])
    radius = np.sqrt(np.maximum([p.area for p in planes], 1e-4) / np.pi)
    turned = np.zeros((len(planes), 4, 3))
    axes = tangents(normal)
    turned[:, :3, :2] = axes.transpose(0, 2, 1) / radius[:, None, None]
    turned[:, 3, :2] = -(axes @ centroid[..., None])[..., 0] / radius[:, None]
    turned[:, 3, 2] = 1
    result: NDArray[np.float64] = share[:, None, None] * turned @ turned.transpose(0, 2, 1)
    return result


@dataclass
class PlaneFilters:
    """N planes of the fixed frame and what is known of them.

    Attributes
    ----------
    normal, point : (N, 3) float64
        The plane.
    axes : (N, 2, 3) float64
        Tangents e1, e2.
    bias : (N, 3) float64
        Estimated beta.
    covariance : (N, 6, 6) float64
        Of x and beta.
    view : (N, C) float64
        Of the last observation.
    """

    normal: NDArray[np.float64]
    point: NDArray[np.float64]
    axes: NDArray[np.float64]
    bias: NDArray[np.float64]
    covariance: NDArray[np.float64]
    view: NDArray[np.float64]

    @classmethod
    def of(cls, seen: Observations) -> PlaneFilters:
        """Planes seen for the first time."""
        normal = seen.plane[:, :3]
        gap = (normal * seen.centroid).sum(axis=1) + seen.plane[:, 3]
        point = seen.centroid - gap[:, None] * normal
        axes = tangents(normal)
        local = _local(axes, point)
        lasting = local @ seen.lasting
        covariance = np.zeros((len(normal), 6, 6))
        covariance[:, :3, :3] = local @ seen.fresh @ local.transpose(0, 2, 1)
        covariance[:, :3, :3] += lasting @ lasting.transpose(0, 2, 1)
        covariance[:, :3, 3:] = -lasting
        covariance[:, 3:, :3] = -lasting.transpose(0, 2, 1)
        covariance[:, 3:, 3:] = np.eye(3)
        return cls(normal, point, axes, np.zeros((len(normal), 3)), covariance, seen.view)

    @property
    def distance(self) -> NDArray[np.float64]:
        """(N,) distance of the planes in normal . p + distance = 0, metres."""
        return -(self.normal * self.point).sum(axis=1)

    def plane_covariance(self) -> NDArray[np.float64]:
        """(N, 4, 4) covariance of (normal, distance), of rank 3."""
        jacobian = np.zeros((len(self.normal), 4, 3))
        jacobian[:, :3, :2] = self.axes.transpose(0, 2, 1)
        jacobian[:, 3, :2] = -(self.axes @ self.point[:, :, None])[..., 0]
        jacobian[:, 3, 2] = 1
        return jacobian @ self.covariance[:, :3, :3] @ jacobian.transpose(0, 2, 1)

    def where(self, chosen: NDArray) -> PlaneFilters:
        """Some of the planes."""
        return PlaneFilters(*(getattr(self, f.name)[chosen] for f in fields(self)))

    def joined(self, others: PlaneFilters) -> PlaneFilters:
        """These planes followed by others."""
        pairs = ((getattr(self, f.name), getattr(others, f.name)) for f in fields(self))
        return PlaneFilters(*(np.concatenate(pair) for pair in pairs))

    def moved(self, motion: Transform) -> PlaneFilters:
        """The planes in a frame to which `motion` leads."""
        turn = motion.rotation.T
        return PlaneFilters(
            self.normal @ turn,
            self.point @ turn + motion.shift,
            self.axes @ turn,
            self.bias,
            self.covariance,
            self.view,
        )

    def coordinates(
        self, index: NDArray[np.intp], points: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(K, 2) of points (K, 3) on the planes of that `index` (K,), along their axes."""
        result: NDArray[np.float64]
        result = np.einsum('kai,ki->ka', self.axes[index], points - self.point[index])
        return result

    def innovations(
        self, index: NDArray[np.intp], seen: Observations, which: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Chi-squared (K,), of three degrees of freedom, of observations being of planes.

        Parameters
        ----------
        index, which : (K,) int
            Numbers of planes and observations.
        seen : Observations
        """
        spread, gap = self._expected(index, seen, which)[3:]
        # At the centroid of what is seen, where angle and offset do not depend on each other.
        at = np.broadcast_to(np.eye(3), spread.shape).copy()
        at[:, 2, :2] = self.coordinates(index, seen.centroid[which])
        spread = at @ spread @ at.transpose(0, 2, 1)
        spread[:, [0, 1], [0, 1]] += _ANGLE**2
        spread[:, 2, 2] += (_OFFSET * seen.range[which]) ** 2
        gap = (at @ gap[..., None])[..., 0]
        result: NDArray[np.float64] = (gap * np.linalg.solve(spread, gap[..., None])[..., 0]).sum(
            1
        )
        return result

    def update(self, index: NDArray[np.intp], seen: Observations, which: NDArray[np.intp]) -> None:
        """Take in observations, each plane at most one."""
        state, fresh, design, spread, gap = self._expected(index, seen, which)
        gain = np.linalg.solve(spread, design @ state).transpose(0, 2, 1)
        step = (gain @ gap[..., None])[..., 0]
        rest = np.eye(6) - gain @ design
        self.covariance[index] = rest @ state @ rest.transpose(0, 2, 1) + gain @ fresh @ (
            gain.transpose(0, 2, 1)
        )
        alike = self._alike(index, seen, which)
        moved = alike < _ANOTHER
        self.bias[index] = np.where(moved, alike, 1.0) * self.bias[index] + step[:, 3:]
        self.view[index] = np.where(moved, seen.view[which], self.view[index])
        self._shift(index, step[:, :3])

    def alike(
        self, k: int, camera: NDArray[np.float64], gate: float, widest: float, farthest: float
    ) -> NDArray[np.intp]:
        """Other planes that may be the plane `k` by what is known of both.

        Parameters
        ----------
        k : int
        camera : (3,) float64
            Where they are looked at from.
        gate : float
            Largest chi-squared of three degrees of freedom.
        widest, farthest : float
            Largest angle, radians, and offset as share of the distance from `camera`.
        """
        away = np.linalg.norm(self.point - camera, axis=1)
        offset = (self.point - self.point[k]) @ self.normal[k]
        close = self.normal @ self.normal[k] > np.cos(widest)
        close &= np.abs(offset) < farthest * away
        close[k] = False
        m = np.flatnonzero(close)
        gap, spread = self._apart(k, m)
        at = np.broadcast_to(np.eye(3), spread.shape).copy()
        at[:, 2, :2] = self.coordinates(np.full(len(m), k), self.point[m])
        spread = at @ spread @ at.transpose(0, 2, 1)
        spread[:, [0, 1], [0, 1]] += _ANGLE**2
        spread[:, 2, 2] += (_OFFSET * away[m]) ** 2
        gap = (at @ gap[..., None])[..., 0]
        value = (gap * np.linalg.solve(spread, gap[..., None])[..., 0]).sum(axis=1)
        return m[value < gate]

    def absorb(self, k: int, m: int) -> None:
        """Have the plane `k` take in what is known of the plane `m`.

        Both were seen by one sensor, and how their errors hang together is not known: covariance
        intersection (Julier and Uhlmann 1997), weighted as by Niehsen (2002).
        """
        gap, _ = self._apart(k, np.array([m]))
        local = _local(self.axes[[k]], self.point[[k]])[0]
        other = local @ self.plane_covariance()[m] @ local.T
        own = self.covariance[k, :3, :3]
        sizes = np.cbrt([np.linalg.det(other), np.linalg.det(own)])
        weight = sizes / sizes.sum()
        information = [w * np.linalg.inv(c) for w, c in zip(weight, (own, other), strict=True)]
        fused = np.linalg.inv(information[0] + information[1])
        self.covariance[k] = np.eye(6)
        self.covariance[k, :3, :3] = fused
        self.bias[k] = self.view[k] = 0
        self._shift(np.array([k]), (fused @ information[1] @ gap[0])[None])

    def places(
        self, index: NDArray[np.intp], at: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points (K, 3) at coordinates (K, 2) of planes, and their standard deviations (K,)."""
        points = self.point[index] + np.einsum('ka,kai->ki', at, self.axes[index])
        lever = np.column_stack([at, np.ones(len(at))])
        variance = np.einsum('ki,kij,kj->k', lever, self.covariance[index, :3, :3], lever)
        return points, np.sqrt(variance)

    def _apart(
        self, k: int, m: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What planes `m` differ by from the plane `k`, (K, 3), and its covariance (K, 3, 3)."""
        local = _local(self.axes[[k]], self.point[[k]])[0]
        other = np.column_stack([self.normal[m], self.distance[m]])
        return other @ local.T, (
            local @ self.plane_covariance()[m] @ local.T + self.covariance[k, :3, :3]
        )

    def _shift(self, index: NDArray[np.intp], step: NDArray[np.float64]) -> None:
        """Add x to planes; their tangents turn with them."""
        first, second = self.axes[index, 0], self.axes[index, 1]
        normal = self.normal[index] + step[:, :1] * first + step[:, 1:2] * second
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        first = first - (first * normal).sum(axis=1, keepdims=True) * normal
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        self.normal[index] = normal
        self.axes[index] = np.stack([first, np.cross(normal, first)], axis=1)
        self.point[index] -= step[:, 2:] * normal

    def _expected(
        self, index: NDArray[np.intp], seen: Observations, which: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], ...]:
        """Covariances of the state (K, 6, 6) and of v (K, 3, 3), [I B] and its covariance, z."""
        alike = self._alike(index, seen, which)
        rho = np.where(alike < _ANOTHER, alike, 1.0)
        scale = np.ones((len(index), 6))
        scale[:, 3:] = rho
        state = self.covariance[index] * scale[:, :, None] * scale[:, None]
        state[:, [3, 4, 5], [3, 4, 5]] += 1 - rho**2
        local = _local(self.axes[index], self.point[index])
        back = local.transpose(0, 2, 1)
        lasting, fresh = local @ seen.lasting[which], local @ seen.fresh[which] @ back
        fresh = fresh + np.where(rho < 1, 0, 1 - alike**2)[..., None] * (
            lasting @ lasting.transpose(0, 2, 1)
        )
        design = np.concatenate([np.broadcast_to(np.eye(3), lasting.shape), lasting], axis=2)
        spread = design @ state @ design.transpose(0, 2, 1) + fresh
        expected = lasting @ (rho * self.bias[index])[..., None]
        gap = (local @ seen.plane[which][..., None] - expected)[..., 0]
        return state, fresh, design, spread, gap

    def _alike(
        self, index: NDArray[np.intp], seen: Observations, which: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """(K, 1) correlation of beta with that of the last observation."""
        rho: NDArray[np.float64] = (self.view[index] * seen.view[which]).sum(1, keepdims=True)
        return np.clip(rho, 0, 1)


def tangents(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors across each unit normal (N, 3), right-handed with it: (N, 2, 3)."""
    across = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(across, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first)], axis=1)


def _local(axes: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3, 4) from (normal, distance) to (a, b, c)."""
    local = np.zeros((len(axes), 3, 4))
    local[:, :2, :3] = axes
    local[:, 2, :3] = point
    local[:, 2, 3] = 1
    return local


def _cross(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3, 3) matrices of cross products: _cross(a) @ b = a x b."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
