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

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.fitting.coplanar import RESIDUE
from rangeseg_ros.core.mapping.plane_set import PlaneSet
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.sensor import length_of_distortion
from rangeseg_ros.core.tracking.plane_errors import congruent, to_errors

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
    """M planes of a frame in the fixed frame, their points next to the centroids.

    `covariance` (M, 3, 3) is of what the sensor makes them err by: `LASTING` of it lasts, the rest
    is new. `by_pose` (M, 3, 6) is what they err by with the pose: with the turn of the camera
    about itself and with its shift, each over its standard deviation. `view` (M, C) see `views`.
    """

    planes: PlaneSet
    covariance: NDArray[np.float64]
    by_pose: NDArray[np.float64]
    view: NDArray[np.float64]

    @property
    def spread(self) -> NDArray[np.float64]:
        """(M, 3, 3) covariance of all of their errors."""
        return self.covariance + congruent(self.by_pose, np.eye(6))

    def where(self, chosen: NDArray[Any] | list[int]) -> Observations:
        """Some of them."""
        return Observations(self.planes.where(chosen), *(part[chosen] for part in self[1:]))


def observations(
    planes: Sequence[Plane], view: NDArray[np.float64], pose: Transform, noise: PoseNoise
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
    by_pose = seen.by_motion(pose.shift) * np.repeat([noise.turn, noise.shift], 3)
    return Observations(seen, covariance, by_pose, view)


def continuity(before: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlation (K,) of the errors that last of planes with views (K, C) before and now.

    Where most of the pixels are the same it is 1: small motions to and fro are no new looks.
    """
    alike = np.clip((before * now).sum(axis=1), 0, 1)
    return np.where(alike >= 0.5, 1.0, alike)


def views(
    labels: NDArray[np.uint16], planes: Sequence[Plane], stated: float
) -> NDArray[np.float64]:
    """Where in the image planes are: pixels in each of its square cells, as unit vectors (M, C).

    Cells are twice as large as the pixels over which the errors of the sensor hang together, as
    the parameter `distortion_length` has `stated`.
    """
    length = length_of_distortion(stated, labels.shape)
    step = max(int(2 * length // _SAMPLES), 1)
    coarse = labels[::step, ::step]
    side = max(int(2 * length / step), 1)
    rows, columns = (np.arange(size) // side for size in coarse.shape)
    cell = rows[:, None] * (columns[-1] + 1) + columns
    count = int(cell[-1, -1]) + 1
    listed = np.array([plane.label for plane in planes], np.intp)
    number = np.zeros(max(int(listed.max(initial=0)), int(coarse.max(initial=0))) + 1, np.intp)
    number[listed] = np.arange(1, len(planes) + 1)
    pixels = np.bincount(
        (number[coarse] * count + cell).ravel(), minlength=(len(planes) + 1) * count
    )
    found = pixels.reshape(-1, count)[1:]
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1))
