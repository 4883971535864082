"""Planes estimated from many observations: an information filter per plane, all of them at once.

An observation differs from the plane by z = x + v, x the error of the plane, three numbers
(`plane_errors`). The part of v that lasts (`observations`) is the same in all frames of a run in
which the plane is seen by the same pixels: the first k of them tell as much as their mean, whose
covariance is F / k + L, with F of what is new in every frame and L of what lasts. The k-th adds
what that information has grown by.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.observations import Observations, continuity
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.tracking.plane_errors import (
    GATE,
    by_motion,
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
    """Observations and what they tell of their planes when they come.

    Attributes
    ----------
    plane, observation : (K,) int
        Their numbers.
    looks : (K,) int
        Frames of the run, this one included.
    information : (K, 3, 3) float64
        What they add.
    spread : (K, 3, 3) float64
        Covariance of z.
    gap : (K, 3) float64
        z.
    """

    plane: NDArray[np.intp]
    observation: NDArray[np.intp]
    looks: NDArray[np.intp]
    information: NDArray[np.float64]
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
    covariance : (N, 3, 3) float64
        Of x.
    view : (N, C) float64
        Of the first observation of this run.
    looks : (N,) int
        Observations of this run.
    """

    normal: NDArray[np.float64]
    point: NDArray[np.float64]
    axes: NDArray[np.float64]
    covariance: NDArray[np.float64]
    view: NDArray[np.float64]
    looks: NDArray[np.intp]

    @classmethod
    def of(cls, seen: Observations) -> PlaneFilters:
        """Planes seen for the first time."""
        normal, axes, point = seen.tangent_frame()
        covariance = congruent(to_errors(axes, point), seen.covariance())
        return cls(normal, point, axes, covariance, seen.view, np.ones(len(normal), np.intp))

    @property
    def distance(self) -> NDArray[np.float64]:
        """(N,) distance of the planes in normal . p + distance = 0, metres."""
        return -(self.normal * self.point).sum(axis=1)

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

    def moved(self, motion: Transform) -> PlaneFilters:
        """The planes moved with all that is known of them."""
        turn, shift = motion
        normal, point = self.normal @ turn.T, self.point @ turn.T + shift
        return replace(self, normal=normal, point=point, axes=self.axes @ turn.T)

    def with_motion_error(
        self, covariance: NDArray[np.float64], place: NDArray[np.float64]
    ) -> PlaneFilters:
        """The planes with the error (6, 6) of a motion: a turn about `place` (3,), a shift."""
        design = by_motion(self.normal, self.axes, self.point - place)
        return replace(self, covariance=self.covariance + congruent(design, covariance))

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
        same = continuity(self.view[index], seen.view[which]) == 1
        looks = np.where(same, self.looks[index] + 1, 1)
        local = to_errors(self.axes[index], self.point[index])
        fresh = congruent(local, seen.fresh[which])
        lasting = congruent(local @ seen.lasting[which], _IDENTITY)
        k = looks[:, None, None]
        before = np.linalg.inv(fresh / np.maximum(k - 1, 1) + lasting) * (k > 1)
        information = np.linalg.inv(fresh / k + lasting) - before
        gap = (local @ seen.plane[which][..., None])[..., 0]
        spread = self.covariance[index] + fresh + lasting
        return Step(index, which, looks, information, spread, gap)

    def gate(self, step: Step, seen: Observations) -> NDArray[np.float64]:
        """Chi-squared (K,), of three degrees of freedom, of observations being of planes."""
        which = step.observation
        at = self.coordinates(step.plane, seen.centroid[which])
        return _gate_at(at, step.gap, step.spread, seen.range[which])

    def update(self, step: Step, seen: Observations) -> None:
        """Take in observations, each plane at most one, that are `expected` as it is now."""
        index, gain = step.plane, step.information
        covariance = np.linalg.inv(np.linalg.inv(self.covariance[index]) + gain)
        self.covariance[index], self.looks[index] = covariance, step.looks
        first = step.looks == 1
        self.view[index[first]] = seen.view[step.observation[first]]
        self._shift(index, (covariance @ gain @ step.gap[..., None])[..., 0])

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
        self.covariance[k] = np.linalg.inv(information[0] + information[1])
        self.view[k] = 0
        self._shift(index, (self.covariance[k] @ information[1] @ gap[0])[None])

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
