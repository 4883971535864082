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

from rangeseg_ros.core.mapping.observations import Observations, persistence
from rangeseg_ros.core.mapping.plane_errors import from_errors, shifted, tangents, to_errors
from rangeseg_ros.core.tracking.tracks import ANGLE, OFFSET


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
        normal = seen.plane[:, :3]
        gap = (normal * seen.centroid).sum(axis=1) + seen.plane[:, 3]
        point = seen.centroid - gap[:, None] * normal
        axes = tangents(normal)
        local = to_errors(axes, point)
        own = _turned(local, seen.fresh)
        return cls(normal, point, axes, own, -local @ seen.lasting, seen.view)

    @property
    def distance(self) -> NDArray[np.float64]:
        """(N,) distance of the planes in normal . p + distance = 0, metres."""
        return -(self.normal * self.point).sum(axis=1)

    def plane_covariance(self, index: NDArray[np.intp]) -> NDArray[np.float64]:
        """(K, 4, 4) covariance of (normal, distance) of some planes, of rank 3."""
        jacobian = from_errors(self.axes[index], self.point[index])
        return _turned(jacobian, self._covariance(index))

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

    def innovations(self, step: Step, seen: Observations) -> NDArray[np.float64]:
        """Chi-squared (K,), of three degrees of freedom, of observations being of planes."""
        at = self.coordinates(step.plane, seen.centroid[step.observation])
        return _chi_squared(step.gap, step.spread, at, seen.range[step.observation])

    def update(self, step: Step, seen: Observations) -> None:
        """Take in observations, each plane at most one, that are `expected` as it is now."""
        index, which = step.plane, step.observation
        state = step.own + step.before @ (step.before + step.lasting).transpose(0, 2, 1)
        solved = np.linalg.solve(step.spread, state.transpose(0, 2, 1))
        gain = np.asarray(solved.transpose(0, 2, 1), np.float64)
        rest = np.eye(3) - gain
        self.own[index] = _turned(rest, step.own) + _turned(gain, step.fresh)
        self.lasting[index] = rest @ step.before - gain @ step.lasting
        other = step.rho < 1
        self.view[index[other]] = seen.view[which[other]]
        self._shift(index, (gain @ step.gap[..., None])[..., 0])

    def follow_views(self, cells: int) -> None:
        """Where images are of another size now, what comes is of other pixels than before."""
        if self.view.shape[1] != cells:
            self.view = np.zeros((len(self.view), cells))

    def alike(
        self,
        some: NDArray[np.intp],
        camera: NDArray[np.float64],
        gate: float,
        widest: float,
        farthest: float,
    ) -> list[tuple[int, int]]:
        """Pairs of one of `some` planes and another that may be it by what is known of both.

        Parameters
        ----------
        some : (K,) int
        camera : (3,) float64
            Where they are looked at from.
        gate : float
            Largest chi-squared of three degrees of freedom.
        widest, farthest : float
            Largest angle, radians, and offset as share of the distance from `camera`.
        """
        normal = self.normal[some]
        offset = normal @ self.point.T + self.distance[some][:, None]
        away = np.linalg.norm(self.point - camera, axis=1)
        close = normal @ self.normal.T > np.cos(widest)
        close &= np.abs(offset) < farthest * away
        close[np.arange(len(some)), some] = False
        number, m = np.nonzero(close)
        if not len(m):
            return []
        k = some[number]
        gap, spread = self._apart(k, m)
        at = self.coordinates(k, self.point[m])
        fits = _chi_squared(gap, spread, at, away[m]) < gate
        return list(zip(k[fits].tolist(), m[fits].tolist(), strict=True))

    def absorb(self, k: int, m: int) -> None:
        """Have the plane `k` take in what is known of the plane `m`.

        Both were seen by one sensor, and how their errors hang together is not known: covariance
        intersection (Julier and Uhlmann 1997), weighted as by Niehsen (2002).
        """
        gap, _ = self._apart(np.array([k]), np.array([m]))
        local = to_errors(self.axes[[k]], self.point[[k]])[0]
        other = local @ self.plane_covariance(np.array([m]))[0] @ local.T
        own = self._covariance(np.array([k]))[0]
        sizes = np.cbrt([np.linalg.det(other), np.linalg.det(own)])
        weight = sizes / sizes.sum()
        information = [w * np.linalg.inv(c) for w, c in zip(weight, (own, other), strict=True)]
        fused = np.linalg.inv(information[0] + information[1])
        self.own[k] = fused
        self.lasting[k] = self.view[k] = 0
        self._shift(np.array([k]), (fused @ information[1] @ gap[0])[None])

    def points(self, index: NDArray[np.intp], at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (K, 3) at coordinates (K, 2) of planes."""
        along: NDArray[np.float64] = np.einsum('ka,kai->ki', at, self.axes[index])
        return self.point[index] + along

    def variances(
        self, index: NDArray[np.intp], which: NDArray[np.intp], at: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Variances (K,), across the planes, at coordinates (K, 2) of the planes index[which]."""
        lever = np.column_stack([at, np.ones(len(at))])
        covariance = self._covariance(index)
        variance: NDArray[np.float64]
        variance = np.einsum('ki,kij,kj->k', lever, covariance[which], lever)
        return variance

    def _apart(
        self, k: NDArray[np.intp], m: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What planes `m` differ by from planes `k`, (K, 3), and its covariance (K, 3, 3)."""
        local = to_errors(self.axes[k], self.point[k])
        other = np.column_stack([self.normal[m], self.distance[m]])
        spread = _turned(local, self.plane_covariance(m)) + self._covariance(k)
        return (local @ other[..., None])[..., 0], spread

    def _covariance(self, index: NDArray[np.intp]) -> NDArray[np.float64]:
        """(K, 3, 3) of x."""
        return self.own[index] + _squared(self.lasting[index])

    def _shift(self, index: NDArray[np.intp], step: NDArray[np.float64]) -> None:
        """Take errors off planes."""
        moved = shifted(self.normal[index], self.point[index], self.axes[index], step)
        self.normal[index], self.point[index], self.axes[index] = moved

    def expected(
        self, index: NDArray[np.intp], seen: Observations, which: NDArray[np.intp]
    ) -> Step:
        """What observations, of the numbers `which` (K,), are to planes `index` (K,)."""
        rho, new = persistence(self.view[index], seen.view[which])
        before = self.lasting[index]
        # What beta loses of what it was is on its own from now on.
        own = self.own[index] + (1 - rho**2)[:, None, None] * _squared(before)
        before = rho[:, None, None] * before
        local = to_errors(self.axes[index], self.point[index])
        lasting = local @ seen.lasting[which]
        fresh = _turned(local, seen.fresh[which]) + new[:, None, None] * _squared(lasting)
        spread = own + _squared(before + lasting) + fresh
        gap = (local @ seen.plane[which][..., None])[..., 0]
        return Step(index, which, rho, own, before, lasting, fresh, spread, gap)


class Step(NamedTuple):
    """Observations and what is known of their planes when they come.

    Attributes
    ----------
    plane, observation : (K,) int
        Their numbers.
    rho : (K,) float64
        Correlation of beta with what it was.
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
    rho: NDArray[np.float64]
    own: NDArray[np.float64]
    before: NDArray[np.float64]
    lasting: NDArray[np.float64]
    fresh: NDArray[np.float64]
    spread: NDArray[np.float64]
    gap: NDArray[np.float64]

    def where(self, chosen: NDArray) -> Step:
        """Some of them."""
        return Step(*(part[chosen] for part in self))


def _squared(root: NDArray[np.float64]) -> NDArray[np.float64]:
    square: NDArray[np.float64] = root @ root.transpose(0, 2, 1)
    return square


def _turned(by: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = by @ covariance @ by.transpose(0, 2, 1)
    return result


def _chi_squared(
    gap: NDArray[np.float64],
    spread: NDArray[np.float64],
    at: NDArray[np.float64],
    range: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Chi-squared (K,) of differences of planes `gap` (K, 3) with covariances (K, 3, 3).

    At coordinates `at` (K, 2), where angle and offset do not depend on each other, and with what
    parts of one surface differ by, at a `range` (K,).
    """
    there = np.broadcast_to(np.eye(3), spread.shape).copy()
    there[:, 2, :2] = at
    spread = there @ spread @ there.transpose(0, 2, 1)
    spread[:, [0, 1], [0, 1]] += ANGLE**2
    spread[:, 2, 2] += (OFFSET * range) ** 2
    gap = (there @ gap[..., None])[..., 0]
    result: NDArray[np.float64]
    result = (gap * np.linalg.solve(spread, gap[..., None])[..., 0]).sum(axis=1)
    return result
