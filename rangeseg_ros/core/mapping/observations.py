"""The planes of a frame as measurements: what they err by, and which part of that lasts.

The error of a depth camera is mostly a pattern that stays in its place in the image, so that
looking on at 30 Hz does not make it smaller: that part of a plane's error lasts from one
observation to the next as much as both were of the same pixels. The rest is new in every frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Labels
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.distortion import in_pixels
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import length_of_distortion
from rangeseg_ros.core.tracking.plane_errors import (
    by_motion,
    congruent,
    from_errors,
    shifted,
    tangents,
    to_errors,
)

# Share of the variance of planes that lasts while the same pixels see them: of the smooth
# distortion, nearly all of the error of a plane, 55 % was found to be one pattern in eight real
# frames of a sequence, and 80 % is one in the simulated sensor.
LASTING = 0.8
# What the parts of a face differ by beyond their errors, as factor of variances: the residue of
# bands, of grazing views and of ragged borders, from 239 pairs in simulated rooms (median 2.9).
RESIDUE = 2.5
# Samples along a side of a cell of the image, see `views`.
_SAMPLES = 16


class PlaneSet(NamedTuple):
    """N planes, unit normals and points on them, metres; the errors x are those of `plane_errors`.

    The tangents `axes` turn with their plane: a motion leaves its error x = (a, b, c) as it is.
    """

    normal: Floats
    point: Floats
    axes: Floats

    @classmethod
    def of(cls, planes: Sequence[Plane]) -> PlaneSet:
        """Planes with the points next to their centroids."""
        normal = np.array([plane.normal for plane in planes], np.float64).reshape(-1, 3)
        centroid = np.array([plane.centroid for plane in planes], np.float64).reshape(-1, 3)
        offset = (normal * centroid).sum(axis=1) + [plane.distance for plane in planes]
        return cls(normal, centroid - offset[:, None] * normal, tangents(normal))

    @property
    def distance(self) -> Floats:
        """(N,) of normal . p + distance = 0, metres."""
        return -(self.normal * self.point).sum(axis=1)

    @property
    def equations(self) -> Floats:
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

    def without(self, errors: Floats) -> PlaneSet:
        """The planes without these errors (N, 3)."""
        return PlaneSet(*shifted(*self, errors))

    def by_motion(self, place: Floats) -> Floats:
        """(N, 3, 6) what a turn about `place` (3,) or (N, 3) and a shift of planes change."""
        return by_motion(self.normal, self.axes, self.point - place)

    def by_field(self, view: Floats, rays: Floats) -> Floats:
        """(N, 3, C) what planes err by with errors of the inverse range in C cells of the image.

        `view` (N, C) is of `views`, `rays` (C, 3) of `cell_rays`; planes are where the camera sees
        them: of y = a . r, a = -n / distance, the pixels change a by least squares.
        """
        weighted = view[:, None] * rays.T
        change = np.linalg.pinv(weighted @ rays, hermitian=True) @ weighted
        normal, distance = self.normal[:, :, None], self.distance[:, None, None]
        along = np.swapaxes(normal, 1, 2) @ change
        equations = np.concatenate(
            [distance * (normal * along - change), distance**2 * along], axis=1
        )
        return np.asarray(to_errors(self.axes, self.point) @ equations)

    def apart(self, others: PlaneSet) -> tuple[Floats, Floats]:
        """What others differ by, (N, 3), as errors of these, and (N, 3, 3) that by their own."""
        local = to_errors(self.axes, self.point)
        gap = (local @ others.equations[..., None])[..., 0]
        return gap, local @ from_errors(others.axes, others.point)

    def covariances(self, errors: Floats) -> Floats:
        """(N, 4, 4) of normals and distances, of rank 3, for those of errors (N, 3, 3)."""
        return congruent(from_errors(self.axes, self.point), errors)

    def coordinates(self, points: Floats) -> Floats:
        """(N, 2) of a point (N, 3) on each plane, along its axes from its own point."""
        return np.asarray((self.axes * (points - self.point)[:, None]).sum(axis=2))

    def points(self, at: Floats) -> Floats:
        """Points (N, 3) at coordinates (N, 2) on each plane."""
        return self.point + at[:, :1] * self.axes[:, 0] + at[:, 1:] * self.axes[:, 1]


class PoseNoise(NamedTuple):
    """Standard deviations of the pose of a camera: metres and radians, about each axis."""

    shift: float
    turn: float

    @property
    def deviations(self) -> Floats:
        """(6,) of the turn about three axes and of the shift."""
        return np.repeat([self.turn, self.shift], 3)


class Observations(NamedTuple):
    """M planes of a frame in the fixed frame, their points next to the centroids.

    `covariance` (M, 3, 3) is of what the sensor makes them err by: `LASTING` of it lasts, the rest
    is new. `by_pose` (M, 3, 6) is what they err by with the pose: with the turn of the camera
    about itself and with its shift, each over its standard deviation. `view` (M, C) see `views`.
    """

    planes: PlaneSet
    covariance: Floats
    by_pose: Floats
    view: Floats

    @property
    def spread(self) -> Floats:
        """(M, 3, 3) covariance of all of their errors."""
        return self.covariance + congruent(self.by_pose, np.eye(6))

    def where(self, chosen: NDArray[Any] | list[int]) -> Observations:
        """Some of them."""
        return Observations(self.planes.where(chosen), *(part[chosen] for part in self[1:]))


def observations(
    planes: Sequence[Plane], view: Floats, pose: Transform, noise: PoseNoise
) -> Observations:
    """Planes of a frame, with their errors and those of the camera's pose, in the fixed frame."""
    seen = PlaneSet.of(planes)
    covariance = np.array([plane.covariance for plane in planes], np.float64).reshape(-1, 4, 4)
    covariance = RESIDUE * congruent(to_errors(seen.axes, seen.point), covariance)
    # Pixels that a plane does not explain are of another surface or a bent one, and may shift and
    # tilt it by their share of the residual.
    share = np.array([(1 - plane.confidence) * plane.rms**2 for plane in planes])
    tilt = share * np.pi / np.maximum([plane.area for plane in planes], 1e-4)
    covariance[:, range(3), range(3)] += np.stack([tilt, tilt, share], axis=1)
    seen = seen.moved(pose)
    return Observations(seen, covariance, seen.by_motion(pose.shift) * noise.deviations, view)


def continuity(before: Floats, now: Floats) -> Floats:
    """Correlation (K,) of the errors that last of planes with views (K, C) before and now.

    Where most of the pixels are the same it is 1: small motions to and fro are no new looks.
    """
    shared = np.clip((before * now).sum(axis=1), 0, 1)
    return np.where(shared >= 0.5, 1.0, shared)


def views(labels: Labels, planes: Sequence[Plane], distortion_length: float) -> Floats:
    """Where in the image planes are: pixels in each of its square cells, as unit vectors (M, C).

    Cells are twice as large as the pixels over which the errors of the sensor hang together, by
    the parameter `distortion_length`.
    """
    step, cell = _cells(labels.shape, distortion_length)
    coarse, count = labels[::step, ::step], int(cell[-1, -1]) + 1
    listed = np.array([plane.label for plane in planes], np.intp)
    number = np.zeros(max(int(listed.max(initial=0)), int(coarse.max(initial=0))) + 1, np.intp)
    number[listed] = np.arange(1, len(planes) + 1)
    pixels = np.bincount(
        (number[coarse] * count + cell).ravel(), minlength=(len(planes) + 1) * count
    )
    found = pixels.reshape(-1, count)[1:]
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1))


def _cells(shape: tuple[int, int], distortion_length: float) -> tuple[int, Indices]:
    """Step of the pixels that are looked at, and their cells (H / step, W / step)."""
    length = length_of_distortion(distortion_length, shape)
    step = max(int(2 * length // _SAMPLES), 1)
    side = max(int(2 * length / step), 1)
    rows, columns = (np.arange(-(-size // step)) // side for size in shape)
    return step, rows[:, None] * (columns[-1] + 1) + columns


def cell_rays(image: RangeImage, distortion_length: float) -> Floats:
    """(C, 3) mean rays of the cells of `views`."""
    step, cell = _cells(image.shape, distortion_length)
    rays = image.rays[::step, ::step].reshape(-1, 3)
    sums = [np.bincount(cell.ravel(), part) for part in rays.T]
    return np.stack(sums, axis=1) / np.bincount(cell.ravel())[:, None]


def field_in_pixels(field: Floats, shape: tuple[int, int], distortion_length: float) -> NDArray:
    """A field over the cells (C,) of `views` in the pixels of an image (H, W)."""
    step, cell = _cells(shape, distortion_length)
    side = step * int(np.count_nonzero(cell[0] == 0))
    return in_pixels(field.reshape(-1, int(cell[0, -1]) + 1), side, shape)
