"""Planes estimated from many observations: a Kalman filter per plane, all of them at once.

An observation differs from the plane by z = x + B beta + v: x is the error of the plane, three
numbers (`plane_errors`); beta, of unit variance, stands for what lasts of the sensor's error
(`observations`); v is what is new in every frame, that of the camera's pose too. The plane's error
is kept as x = C beta + e, its covariance C C^T + Q.

beta is considered, not estimated (Schmidt, "Application of state-space methods to navigation
problems", 1966): two looks from one place differ by (B' - B) beta, but also by which pixels they
have of a ragged border, and a filter that explains all of that by beta goes on in the same
direction, beyond both. Without lasting errors this is the information filter of a constant.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.observations import Observations, continuity
from rangeseg_ros.core.tracking.plane_errors import (
    GATE,
    candidates,
    congruent,
    from_errors,
    mahalanobis,
    shifted,
    to_errors,
    with_floor,
)

_IDENTITY = np.eye(3)


class Step(NamedTuple):
    """Observations and what is known of their planes when they come.

    Attributes
    ----------
    plane, observation : (K,) int
        Their numbers.
    own, before : (K, 3, 3) float64
        Q and C by this beta.
    lasting, fresh : (K, 3, 3) float64
        B and the covariance of v.
    spread : (K, 3, 3) float64
        Covariance of z.
    gap : (K, 3) float64
        z.
    """

    plane: NDArray[np.intp]
    observation: NDArray[np.intp]
    own: NDArray[np.float64]
    before: NDArray[np.float64]
    lasting: NDArray[np.float64]
    fresh: NDArray[np.float64]
    spread: NDArray[np.float64]
    gap: NDArray[np.float64]

    def where(self, chosen: NDArray) -> Step:
        """Some of them."""
        return Step(*(part[chosen] for part in self))


@dataclass
class PlaneFilters:
    """N planes of the fixed frame and what is known of them.

    Attributes
    ----------
    normal, point : (N, 3) float64
        The plane.
    axes : (N, 2, 3) float64
        Tangents e1, e2.
    own : (N, 3, 3) float64
        Q, the covariance of what x has beside the lasting error.
    lasting : (N, 3, 3) float64
        C, the derivative of x by beta.
    view : (N, C) float64
        Of the last observation.
    """

    normal: NDArray[np.float64]
    point: NDArray[np.float64]
    axes: NDArray[np.float64]
    own: NDArray[np.float64]
    lasting: NDArray[np.float64]
    view: NDArray[np.float64]

    @classmethod
    def of(cls, seen: Observations) -> PlaneFilters:
        """Planes seen for the first time."""
        normal, axes, point = seen.tangent_frame()
        local = to_errors(axes, point)
        own = congruent(local, seen.fresh)
        return cls(normal, point, axes, own, -local @ seen.lasting, seen.view)

    @property
    def distance(self) -> NDArray[np.float64]:
        """(N,) distance of the planes in normal . p + distance = 0, metres."""
        return -(self.normal * self.point).sum(axis=1)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(N, 3, 3) of x."""
        return self.own + congruent(self.lasting, _IDENTITY)

    @property
    def plane_covariance(self) -> NDArray[np.float64]:
        """(N, 4, 4) covariance of (normal, distance), of rank 3."""
        return congruent(from_errors(self.axes, self.point), self.covariance)

    def where(self, chosen: NDArray) -> PlaneFilters:
        """Some of the planes."""
        return PlaneFilters(*(getattr(self, f.name)[chosen] for f in fields(self)))

    def joined(self, others: PlaneFilters) -> PlaneFilters:
        """These planes followed by others."""
        pairs = ((getattr(self, f.name), getattr(others, f.name)) for f in fields(self))
        return PlaneFilters(*(np.concatenate(pair) for pair in pairs))

    def coordinates(
        self, index: NDArray[np.intp], points: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(K, 2) of points (K, 3) on the planes of that `index` (K,), along their axes."""
        result: NDArray[np.float64]
        result = np.einsum('kai,ki->ka', self.axes[index], points - self.point[index])
        return result

    def points(self, index: NDArray[np.intp], at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (K, 3) at coordinates (K, 2) of planes."""
        along: NDArray[np.float64] = np.einsum('ka,kai->ki', at, self.axes[index])
        return self.point[index] + along

    def expected(
        self, index: NDArray[np.intp], seen: Observations, which: NDArray[np.intp]
    ) -> Step:
        """What observations, of the numbers `which` (K,), are to planes `index` (K,)."""
        same = continuity(self.view[index], seen.view[which])
        other = (1 - same**2)[:, None, None]
        before = self.lasting[index]
        # What beta loses of what it was is on its own from now on.
        own = self.own[index] + other * congruent(before, _IDENTITY)
        before = same[:, None, None] * before
        local = to_errors(self.axes[index], self.point[index])
        lasting = local @ seen.lasting[which]
        fresh = congruent(local, seen.fresh[which]) + other * congruent(lasting, _IDENTITY)
        spread = own + congruent(before + lasting, _IDENTITY) + fresh
        gap = (local @ seen.plane[which][..., None])[..., 0]
        return Step(index, which, own, before, lasting, fresh, spread, gap)

    def gate(self, step: Step, seen: Observations) -> NDArray[np.float64]:
        """Chi-squared (K,), of three degrees of freedom, of observations being of planes."""
        which = step.observation
        at = self.coordinates(step.plane, seen.centroid[which])
        return _gate_at(at, step.gap, step.spread, seen.range[which])

    def update(self, step: Step, seen: Observations) -> None:
        """Take in observations, each plane at most one, that are `expected` as it is now."""
        index, which = step.plane, step.observation
        state = step.own + step.before @ (step.before + step.lasting).transpose(0, 2, 1)
        solved = np.linalg.solve(step.spread, state.transpose(0, 2, 1))
        gain = np.asarray(solved.transpose(0, 2, 1), np.float64)
        rest = _IDENTITY - gain
        self.own[index] = congruent(rest, step.own) + congruent(gain, step.fresh)
        self.lasting[index] = rest @ step.before - gain @ step.lasting
        other = continuity(self.view[index], seen.view[which]) < 1
        self.view[index[other]] = seen.view[which[other]]
        self._shift(index, (gain @ step.gap[..., None])[..., 0])

    def alike(self, some: NDArray[np.intp], camera: NDArray[np.float64]) -> list[tuple[int, int]]:
        """Pairs of one of `some` planes (K,) and another that may be it by what is known of both.

        `camera` (3,) is where they are looked at from.
        """
        reach = np.linalg.norm(self.point - camera, axis=1)
        planes = self.normal[some], self.distance[some]
        close = candidates(planes, (self.normal, self.point), reach)
        close[np.arange(len(some)), some] = False
        number, m = np.nonzero(close)
        k = some[number]
        if not len(m):
            return []
        gap, spread = self._apart(k, m)
        at = self.coordinates(k, self.point[m])
        fits = _gate_at(at, gap, spread, reach[m]) < GATE
        return list(zip(k[fits].tolist(), m[fits].tolist(), strict=True))

    def absorb(self, k: int, m: int) -> None:
        """Have the plane `k` take in what is known of the plane `m`.

        Both were seen by one sensor, and how their errors hang together is not known: covariance
        intersection (Julier and Uhlmann 1997), weighted as by Niehsen (2002).
        """
        index = np.array([k])
        gap, spread = self._apart(index, np.array([m]))
        own = self.covariance[k]
        other = spread[0] - own
        sizes = np.cbrt([np.linalg.det(other), np.linalg.det(own)])
        weight = sizes / sizes.sum()
        information = [w * np.linalg.inv(c) for w, c in zip(weight, (own, other), strict=True)]
        self.own[k] = np.linalg.inv(information[0] + information[1])
        self.lasting[k] = self.view[k] = 0
        self._shift(index, (self.own[k] @ information[1] @ gap[0])[None])

    def variances(self, index: NDArray[np.intp], at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variances (K,), across the planes `index` (K,), at coordinates (K, 2)."""
        lever = np.column_stack([at, np.ones(len(at))])
        variance: NDArray[np.float64]
        variance = np.einsum('ki,kij,kj->k', lever, self.covariance[index], lever)
        return variance

    def _apart(
        self, k: NDArray[np.intp], m: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What planes `m` differ by from planes `k`, (K, 3), and its covariance (K, 3, 3)."""
        local = to_errors(self.axes[k], self.point[k])
        other = np.column_stack([self.normal[m], self.distance[m]])
        turned = local @ from_errors(self.axes[m], self.point[m])
        spread = congruent(turned, self.covariance[m]) + self.covariance[k]
        return (local @ other[..., None])[..., 0], spread

    def _shift(self, index: NDArray[np.intp], step: NDArray[np.float64]) -> None:
        """Take errors off planes."""
        moved = shifted(self.normal[index], self.point[index], self.axes[index], step)
        self.normal[index], self.point[index], self.axes[index] = moved


def _gate_at(
    at: NDArray[np.float64],
    gap: NDArray[np.float64],
    spread: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Chi-squared (K,) of differences of planes `gap` (K, 3), at coordinates `at` (K, 2)."""
    there = np.broadcast_to(_IDENTITY, spread.shape).copy()
    there[:, 2, :2] = at
    return mahalanobis(
        (there @ gap[..., None])[..., 0], with_floor(congruent(there, spread), reach)
    )
