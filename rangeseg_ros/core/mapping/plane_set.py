"""Planes as arrays, with the axes that their errors are told along."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.tracking.plane_errors import (
    by_motion,
    congruent,
    from_errors,
    shifted,
    tangents,
    to_errors,
)


class PlaneSet(NamedTuple):
    """N planes, unit normals and points on them, metres; the errors x are those of `plane_errors`.

    The tangents `axes` turn with their plane: a motion leaves its error x = (a, b, c) as it is.
    """

    normal: NDArray[np.float64]
    point: NDArray[np.float64]
    axes: NDArray[np.float64]

    @classmethod
    def of(cls, planes: Sequence[Plane]) -> PlaneSet:
        """Planes with the points next to their centroids."""
        normal = np.array([plane.normal for plane in planes], np.float64).reshape(-1, 3)
        centroid = np.array([plane.centroid for plane in planes], np.float64).reshape(-1, 3)
        offset = (normal * centroid).sum(axis=1) + [plane.distance for plane in planes]
        return cls(normal, centroid - offset[:, None] * normal, tangents(normal))

    @property
    def distance(self) -> NDArray[np.float64]:
        """(N,) of normal . p + distance = 0, metres."""
        return -(self.normal * self.point).sum(axis=1)

    @property
    def equations(self) -> NDArray[np.float64]:
        """(N, 4) normals and distances."""
        return np.column_stack([self.normal, self.distance])

    def where(self, chosen: NDArray[Any] | list[int]) -> PlaneSet:
        """Some of them."""
        return PlaneSet(*(part[chosen] for part in self))

    def joined(self, others: PlaneSet) -> PlaneSet:
        """These planes followed by others."""
        return PlaneSet(*(np.concatenate(pair) for pair in zip(self, others, strict=True)))

    def moved(self, motion: Transform) -> PlaneSet:
        """The planes in another frame; or each by a motion of its own, stacked (N, 3, 3)."""
        turn, shift = motion
        normal, point = ((turn @ part[..., None])[..., 0] for part in self[:2])
        return PlaneSet(normal, point + shift, self.axes @ np.swapaxes(turn, -1, -2))

    def without(self, errors: NDArray[np.float64]) -> PlaneSet:
        """The planes without these errors (N, 3)."""
        return PlaneSet(*shifted(*self, errors))

    def by_motion(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3, 6) what a turn about `place` (3,) or (N, 3) and a shift of planes change."""
        return by_motion(self.normal, self.axes, self.point - place)

    def apart(self, others: PlaneSet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What others differ by, (N, 3), as errors of these, and (N, 3, 3) that by their own."""
        local = to_errors(self.axes, self.point)
        gap = (local @ others.equations[..., None])[..., 0]
        return gap, local @ from_errors(others.axes, others.point)

    def covariances(self, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 4, 4) of normals and distances, of rank 3, for those of errors (N, 3, 3)."""
        return congruent(from_errors(self.axes, self.point), errors)

    def coordinates(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) of a point (N, 3) on each plane, along its axes from its own point."""
        return np.asarray((self.axes * (points - self.point)[:, None]).sum(axis=2))

    def points(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) at coordinates (N, 2) on each plane."""
        return self.point + at[:, :1] * self.axes[:, 0] + at[:, 1:] * self.axes[:, 1]
