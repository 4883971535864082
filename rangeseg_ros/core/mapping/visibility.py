"""What measured rays say of places on planes of a map: seen there, or seen through."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import OUTLIER

THERE, UNSEEN, THROUGH = 1, 0, -1  # what a ray says of a place
# Least cosine of incidence: 3 degrees, where rays run along what they could pass through.
_GRAZING = 0.05


def may_be_in_sight(
    centres: NDArray[np.float64], radii: NDArray[np.float64], image: RangeImage
) -> NDArray[np.bool_]:
    """Whether spheres reach into what the camera of an image looks at.

    Parameters
    ----------
    centres : (K, 3) float64
        In the frame of the image, metres.
    radii : (K,) float64
    image : RangeImage
        Of a camera: of a cloud, nobody knows.

    Returns
    -------
    (K,) bool
    """
    camera = image.camera
    if camera is None:
        return np.zeros(len(centres), np.bool_)
    # A cone around the optical axis, through the farthest corner.
    right = max(camera.cx + 0.5, camera.width - 0.5 - camera.cx) / camera.fx
    down = max(camera.cy + 0.5, camera.height - 0.5 - camera.cy) / camera.fy
    slope = float(np.hypot(right, down))
    x, y, z = (centres @ camera.axes).T
    outside: NDArray[np.float64] = np.hypot(x, y) - slope * z
    return (outside <= radii * np.hypot(1, slope)) & (z >= -radii)


def in_image(points: NDArray[np.float64], image: RangeImage) -> NDArray[np.bool_]:
    """Which points (K, 3), in its frame, a camera sees or would see; none for a cloud."""
    if image.camera is None:
        return np.zeros(len(points), np.bool_)
    row, column, depth = _pixels(points, image.camera)
    height, width = image.shape
    inside: NDArray[np.bool_] = (depth > 0) & (column >= 0) & (column < width)
    return inside & (row >= 0) & (row < height)


def ray_evidence(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    variance: NDArray[np.float64],
    image: RangeImage,
    sensor: SensorModel,
) -> NDArray[np.int8]:
    """Whether rays end at points of planes, pass through them or do not get there.

    Parameters
    ----------
    points, normals : (K, 3) float64
        Places and the normals of their planes, in the frame of the image.
    variance : (K,) float64
        Of the places along the normals, square metres.
    image : RangeImage
        Of a camera: in a cloud, nobody knows which pixel looks where.
    sensor : SensorModel

    Returns
    -------
    (K,) int8
        `THERE`, `UNSEEN` (not in the image, not measured, or behind something), `THROUGH`.
    """
    found = np.zeros(len(points), np.int8)
    slope = np.abs((points * normals).sum(axis=1))
    inside = in_image(points, image) & (slope > _GRAZING * np.linalg.norm(points, axis=1))
    k = np.flatnonzero(inside)
    if image.camera is None or not len(k):
        return found
    row, column, depth = _pixels(points[k], image.camera)
    measured = image.inverse[row.astype(np.intp), column.astype(np.intp)].astype(np.float64)
    squared = depth**-2
    error = random_variance(sensor, squared) + systematic_variance(sensor, squared)
    # Along the ray, the inverse depth changes by 1 / z for every n . p.
    error += variance[k] * squared / slope[k] ** 2
    beyond = (1 / depth - measured) / np.sqrt(error)
    seen = (measured > 0) & (beyond >= -OUTLIER)
    found[k[seen]] = np.where(beyond[seen] > OUTLIER, THROUGH, THERE)
    return found


def _pixels(
    points: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Rows and columns of the pixels (K,) that look at points (K, 3), and their depths."""
    x, y, z = (points @ camera.axes).T
    depth = np.where(z > 0, z, 1)
    row, column = np.rint(camera.fy * y / depth + camera.cy), camera.fx * x / depth + camera.cx
    return row, np.rint(column), z
