"""The planes of a frame as measurements: what they err by, and which part of that lasts.

The error of a depth camera is mostly a pattern that stays in its place in the image, so that
looking on at 30 Hz does not make it smaller: that part of a plane's error lasts from one
observation to the next as much as both were of the same pixels. The rest is new in every frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.fitting.coplanar import RESIDUE
from rangeseg_ros.core.fitting.uncertainty import plane_jacobians
from rangeseg_ros.core.mapping.plane_errors import cross_matrices
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.sensor import length_of_distortion

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
    covariance = np.array([p.covariance for p in planes], np.float64).reshape(-1, 4, 4) * RESIDUE
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
    cross = cross_matrices(world)
    by_turn = np.concatenate([-cross, (shift @ cross)[:, None]], axis=1)
    by_shift = np.zeros((len(planes), 4, 3))
    by_shift[:, 3] = -world
    fresh = (1 - LASTING) * square
    for part, sigma in ((by_turn, noise.turn), (by_shift, noise.shift)):
        fresh = fresh + sigma**2 * part @ part.transpose(0, 2, 1)
    return Observations(
        np.column_stack([world, distance - world @ shift]),
        np.sqrt(LASTING) * lasting,
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
    area = np.maximum([p.area for p in planes], 1e-4) / np.pi
    # A tilt about any axis in the plane turns the normal and moves the origin along.
    across = (np.eye(3) - normal[:, :, None] * normal[:, None]) / area[:, None, None]
    moved = -(across @ centroid[..., None])[..., 0]
    result = np.empty((len(planes), 4, 4))
    result[:, :3, :3] = across
    result[:, :3, 3] = result[:, 3, :3] = moved
    result[:, 3, 3] = 1 - (moved * centroid).sum(axis=1)
    result *= share[:, None, None]
    return result


def persistence(
    before: NDArray[np.float64], now: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How much of the error that lasts is that of the observation before.

    Parameters
    ----------
    before, now : (K, C) float64
        Views of planes.

    Returns
    -------
    (K,) float64
        Correlation of beta with that of the observation before; 1 where both are of the same
        pixels.
    (K,) float64
        Share of the variance that is new in this frame all the same.
    """
    alike = np.clip((before * now).sum(axis=1), 0, 1)
    # Most of them are: small motions to and fro do not count as new looks.
    same = alike >= 0.5
    return np.where(same, 1.0, alike), np.where(same, 1 - alike**2, 0.0)


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
