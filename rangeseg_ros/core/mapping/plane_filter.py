"""Planes estimated from many observations: an information filter per plane, all of them at once.

An observation differs from the plane by z = x + v, x the error of the plane, three numbers
(`plane_errors`). The part of v that lasts (`observations`) is the same in all frames of a run in
which the plane is seen by the same pixels: the first k of them tell as much as their mean, whose
covariance is F / k + L, with F of what is new in every frame and L of what lasts. The k-th adds
what that information has grown by.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Mask
from rangeseg_ros.core.mapping.observations import (
    LASTING,
    Observations,
    PlaneSet,
    PoseNoise,
    continuity,
)
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import rotation_by
from rangeseg_ros.core.significance import chi2_quantile
from rangeseg_ros.core.tracking.plane_errors import (
    GATE,
    candidates,
    congruent,
    mahalanobis,
    with_floor,
)

_ROUNDS = 5  # until the motion and the weights settle
# Prior inverse variance of a jump in each direction: 100 standard deviations of the pose noise.
_PRIOR = 1e-4
_GATE = chi2_quantile(6)


class PlaneFilters(NamedTuple):
    """N planes of the fixed frame, with the covariances (N, 3, 3) of their errors.

    `view` (N, C) is that of the first observation of a run, `looks` (N,) how many it has.
    """

    planes: PlaneSet
    covariance: Floats
    view: Floats
    looks: Indices

    @classmethod
    def of(cls, seen: Observations) -> PlaneFilters:
        """Planes where they are seen for the first time, of which nothing else is known yet."""
        # 1 km and 1000 rad, so that the first observation decides.
        unknown = np.tile(1e6 * np.eye(3), (len(seen.view), 1, 1))
        return cls(seen.planes, unknown, 0 * seen.view, np.zeros(len(seen.view), np.intp))

    def where(self, chosen: NDArray[Any] | list[int]) -> PlaneFilters:
        """Some of the planes."""
        parts: list[Any] = [part[chosen] for part in self[1:]]
        return PlaneFilters(self.planes.where(chosen), *parts)

    def moved(self, motion: Transform, place: Floats, error: Floats) -> PlaneFilters:
        """The planes in another frame; the motion errs by a turn about `place` and a shift.

        `error` (6, 6) is the covariance of these.
        """
        planes = self.planes.moved(motion)
        by_motion = congruent(planes.by_motion(place), error)
        return self._replace(planes=planes, covariance=self.covariance + by_motion)

    def joined(self, others: PlaneFilters) -> PlaneFilters:
        """These planes followed by others."""
        pairs = zip(self[1:], others[1:], strict=True)
        parts: list[Any] = [np.concatenate(pair) for pair in pairs]
        return PlaneFilters(self.planes.joined(others.planes), *parts)

    def matches(
        self, others: PlaneSet, covariance: Floats, camera: Floats
    ) -> tuple[Indices, Indices, Floats]:
        """Which of these planes and of M others may be one by what is known of both.

        Numbers (K,) of these and (K,) of the others, and chi-squared (K,) of three degrees of
        freedom; `covariance` (M, 3, 3) is of the errors of the others, `camera` (3,) where they
        are looked at from.
        """
        reach = np.linalg.norm(others.point - camera, axis=1)
        own = self.planes.normal, self.planes.distance
        k, m = np.nonzero(candidates(own, (others.normal, others.point), reach))
        planes, others = self.planes.where(k), others.where(m)
        gap, turned = planes.apart(others)
        # Where the other one is.
        there = np.tile(np.eye(3), (len(k), 1, 1))
        there[:, 2, :2] = planes.coordinates(others.point)
        spread = congruent(there, self.covariance[k] + congruent(turned, covariance[m]))
        value = mahalanobis((there @ gap[..., None])[..., 0], with_floor(spread, reach[m]))
        fits = value < GATE
        return k[fits], m[fits], value[fits]

    def update(self, index: Indices, seen: Observations) -> Mask:
        """Take in what is seen of the planes `index` (K,), each at most once; which runs begin."""
        planes = self.planes.where(index)
        gap, turned = planes.apart(seen.planes)
        same = continuity(self.view[index], seen.view) == 1
        looks = np.where(same, self.looks[index] + 1, 1)
        lasting = LASTING * congruent(turned, seen.covariance)
        fresh = congruent(turned, seen.spread) - lasting
        k = looks[:, None, None]
        before = np.linalg.inv(fresh / np.maximum(k - 1, 1) + lasting) * (k > 1)
        gain = np.linalg.inv(fresh / k + lasting) - before
        covariance = np.linalg.inv(np.linalg.inv(self.covariance[index]) + gain)
        self._correct(index, covariance, gain @ gap[..., None])
        self.looks[index], self.view[index[~same]] = looks, seen.view[~same]
        return ~same

    def absorb(self, k: int, m: int) -> None:
        """Have the plane `k` take in what is known of the plane `m`.

        Both were seen by one sensor, and how their errors hang together is not known: covariance
        intersection (Julier and Uhlmann 1997), weighted as by Niehsen (2002).
        """
        gap, turned = self.planes.where([k]).apart(self.planes.where([m]))
        both = np.stack([self.covariance[k], turned[0] @ self.covariance[m] @ turned[0].T])
        weight = np.cbrt(np.linalg.det(both))[::-1, None, None]
        own, other = weight / weight.sum() * np.linalg.inv(both)
        self._correct(np.array([k]), np.linalg.inv(own + other)[None], other @ gap[..., None])
        self.view[k] = 0

    def _correct(self, index: Indices, covariance: Floats, gap: Floats) -> None:
        """Take the errors that covariance @ gap (K, 3, 1) is off the planes `index` (K,)."""
        moved = self.planes.where(index).without((covariance @ gap)[..., 0])
        for whole, part in zip(self.planes, moved, strict=True):
            whole[index] = part
        self.covariance[index] = covariance

    def variances(self, index: Indices, at: Floats) -> Floats:
        """Variances (K,), across the planes `index` (K,), at coordinates (K, 2)."""
        lever = np.column_stack([at, np.ones(len(at))])
        variance: Floats
        variance = np.einsum('ki,kij,kj->k', lever, self.covariance[index], lever)
        return variance


class Jump(NamedTuple):
    """What the fixed frame has moved by against the planes.

    `motion` leads from the fixed frame as it was to what it is; `error` (6,) is that motion as a
    turn about where the `camera` (3,) was said to be, radians, and a shift, metres. Its covariance
    is large in directions that the planes do not tell.
    """

    motion: Transform
    camera: Floats
    error: Floats
    covariance: Floats

    def __str__(self) -> str:
        turn, shift = np.linalg.norm(self.error.reshape(2, 3), axis=1)
        return (
            f'the planes contradict the pose by {1e3 * shift:.0f} mm and '
            f'{np.degrees(turn):.1f} degrees'
        )


def find_jump(
    known: PlaneFilters, seen: Observations, camera: Floats, noise: PoseNoise
) -> Jump | None:
    """Test the pose of a frame by K planes of the map that it shows, in the same order.

    A pose that errs by s, in standard deviations, shows each plane off by z = -B s + v. With
    L = sum B^T R^-1 B the estimate of s has the covariance L^-1 + I, so that s^T L (L + I)^-1 s
    is chi-squared with six degrees of freedom: None where it is chance. Planes that move by
    themselves have less weight (Cauchy). `camera` (3,) is where the given pose has it.
    """
    deviations = noise.deviations
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
