"""The planes of a frame as measurements: what they err by, and which part of that lasts.

The error of a depth camera is mostly a pattern that stays in its place in the image, so that
looking on at 30 Hz does not make it smaller: that part of a plane's error lasts from one
observation to the next as much as both were of the same pixels. The rest is new in every frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.fitting.coplanar import RESIDUE
from rangeseg_ros.core.fitting.uncertainty import plane_jacobians
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.sensor import length_of_distortion
from rangeseg_ros.core.tracking.plane_errors import (
    by_motion,
    congruent,
    from_errors,
    moved_plane,
    tangents,
)

if TYPE_CHECKING:
    from rangeseg_ros.core.mapping.pose_jumps import Jump

# Share of the variance of planes that lasts while the same pixels see them: of the smooth
# distortion, nearly all of the error of a plane, 55 % was found to be one pattern in eight real
# frames of a sequence, and 80 % is one in the simulated sensor.
LASTING = 0.8
# Samples along a side of a cell of the image, see `views`.
_SAMPLES = 16


class PoseNoise(NamedTuple):
    """Standard deviations of the pose of a camera: metres and radians, about each axis."""

    shift: float
    turn: float


class Sighting(NamedTuple):
    """What a frame shows of the planes of a map.

    Attributes
    ----------
    pose : Transform
        Fixed frame from the frame of the image.
    planes : sequence of Plane
        M of them, in the frame of the image.
    ids : (M,) int
        Of the planes of the map that they are.
    view : (M, C) float64
        See `views`.
    jump : Jump or None
        Of the fixed frame since the frame before.
    """

    pose: Transform
    planes: Sequence[Plane]
    ids: NDArray[np.int64]
    view: NDArray[np.float64]
    jump: Jump | None = None


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
    by_pose : (M, 4, 6) float64
        Square root of that part of it which is of the pose: by the turn of the camera about
        itself and by its shift, each over its standard deviation.
    centroid : (M, 3) float64
    range : (M,) float64
        Distance of the centroid from the camera, metres.
    view : (M, C) float64
        Unit vectors: how many pixels of each cell of the image the plane had.
    """

    plane: NDArray[np.float64]
    lasting: NDArray[np.float64]
    fresh: NDArray[np.float64]
    by_pose: NDArray[np.float64]
    centroid: NDArray[np.float64]
    range: NDArray[np.float64]
    view: NDArray[np.float64]

    def where(self, chosen: ArrayLike) -> Observations:
        """Some of them, by their numbers."""
        index = np.array(chosen, np.intp)
        return Observations(*(part[index] for part in self))

    def covariance(self) -> NDArray[np.float64]:
        """(M, 4, 4) of all of the error."""
        return self.fresh + congruent(self.lasting, np.eye(3))

    def tangent_frame(self) -> tuple[NDArray[np.float64], ...]:
        """Normals (M, 3), their tangents (M, 2, 3), and points (M, 3) on the planes."""
        normal = self.plane[:, :3]
        offset = (normal * self.centroid).sum(axis=1) + self.plane[:, 3]
        return normal, tangents(normal), self.centroid - offset[:, None] * normal


def observations(
    planes: Sequence[Plane], view: NDArray[np.float64], pose: Transform, noise: PoseNoise
) -> Observations:
    """Planes of a frame, with their errors and those of the camera's pose, in the fixed frame."""
    normal = np.array([p.normal for p in planes], np.float64).reshape(-1, 3)
    distance = np.array([p.distance for p in planes], np.float64)
    centroid = np.array([p.centroid for p in planes], np.float64).reshape(-1, 3)
    covariance = np.array([p.covariance for p in planes], np.float64).reshape(-1, 4, 4)
    covariance = RESIDUE * covariance + _unexplained(planes, normal, centroid)
    # In the form theta . ray = 1 / z the pattern of the image is the same at any distance.
    back = np.zeros((len(planes), 3, 4))
    back[:, :, :3] = -np.eye(3) / distance[:, None, None]
    back[:, :, 3] = normal / distance[:, None] ** 2
    values, vectors = np.linalg.eigh(congruent(back, covariance))
    # The symmetric root, as beta is to mean the same in every frame.
    root = (vectors * np.sqrt(np.maximum(values, 0))[:, None]) @ vectors.transpose(0, 2, 1)
    to_world = moved_plane(*pose)
    lasting = to_world @ plane_jacobians(normal, distance) @ root
    world, place = normal @ pose.rotation.T, centroid @ pose.rotation.T
    axes = tangents(world)
    by_pose = from_errors(axes, place + pose.shift) @ by_motion(world, axes, place)
    by_pose *= np.repeat([noise.turn, noise.shift], 3)
    fresh = (1 - LASTING) * congruent(lasting, np.eye(3))
    return Observations(
        np.column_stack([normal, distance]) @ to_world.T,
        np.sqrt(LASTING) * lasting,
        fresh + congruent(by_pose, np.eye(6)),
        by_pose,
        place + pose.shift,
        np.asarray(np.linalg.norm(centroid, axis=1)),
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
    area = np.maximum([p.area for p in planes], 1e-4) / np.pi
    variance = share[:, None] * np.stack([1 / area, 1 / area, np.ones(len(area))], axis=1)
    jacobian = from_errors(tangents(normal), centroid)
    return congruent(jacobian * np.sqrt(variance)[:, None], np.eye(3))


def continuity(before: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlation (K,) of the error that lasts with that of the observation before.

    Parameters
    ----------
    before, now : (K, C) float64
        Views of planes. Where most of the pixels are the same it is 1: small motions to and fro
        are no new looks.
    """
    alike = np.clip((before * now).sum(axis=1), 0, 1)
    return np.where(alike >= 0.5, 1.0, alike)


def views(
    labels: NDArray[np.uint16], planes: Sequence[Plane], stated: float
) -> NDArray[np.float64]:
    """Where in the image planes are: pixels in each square cell, as unit vectors.

    Parameters
    ----------
    labels : (H, W) uint16
    planes : sequence of Plane
    stated : float
        The parameter `distortion_length`, pixels over which the errors of the sensor hang
        together: cells are twice as large.

    Returns
    -------
    (M, C) float64
    """
    length = length_of_distortion(stated, labels.shape)
    step = max(int(2 * length // _SAMPLES), 1)
    coarse = labels[::step, ::step]
    side = max(int(2 * length / step), 1)
    rows, columns = (np.arange(size) // side for size in coarse.shape)
    count = int(rows[-1] + 1) * int(columns[-1] + 1)
    listed = np.array([plane.label for plane in planes], np.intp)
    first = np.zeros(max(int(listed.max(initial=0)), int(coarse.max(initial=0))) + 1, np.intp)
    first[listed] = count * np.arange(1, len(planes) + 1)
    place = first[coarse] + (rows[:, None] * (columns[-1] + 1) + columns)
    pixels = np.bincount(place.ravel(), minlength=count * (len(planes) + 1))
    found = pixels.reshape(-1, count)[1:].astype(np.float64)
    norm: NDArray[np.float64] = np.linalg.norm(found, axis=1, keepdims=True)
    return found / np.maximum(norm, 1)
