"""What an image says of cells of planes of a map: found there, or seen through."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.plane_grid import PlaneGrid
from rangeseg_ros.core.mapping.plane_set import PlaneSet
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import OUTLIER

# Least cosine of incidence: 3 degrees, where rays run along what they could pass through.
_GRAZING = 0.05


def may_be_in_sight(
    centres: NDArray[np.float64], radii: NDArray[np.float64], camera: Camera
) -> NDArray[np.bool_]:
    """Whether spheres, centres (K, 3) and radii (K,) metres, reach into what a camera looks at."""
    # A cone around the optical axis, through the farthest corner.
    right = max(camera.cx + 0.5, camera.width - 0.5 - camera.cx) / camera.fx
    down = max(camera.cy + 0.5, camera.height - 0.5 - camera.cy) / camera.fy
    slope = float(np.hypot(right, down))
    x, y, z = (centres @ camera.axes).T
    outside: NDArray[np.float64] = np.hypot(x, y) - slope * z
    return (outside <= radii * np.hypot(1, slope)) & (z >= -radii)


def labels_of_cells(
    grid: PlaneGrid, plane: PlaneSet, labels: NDArray[np.uint16], camera: Camera
) -> NDArray[np.uint16]:
    """Labels (V, U) of the pixels that look at the cells of a plane, one in the image's frame.

    Cells behind the camera get labels from beyond the horizon of the plane, which are never its
    own.
    """
    # From column, row and 1 to coordinates, points, and pixels.
    place = np.column_stack([grid.side * np.eye(2), grid.side * (grid.first + 0.5)])
    points = plane.axes[0].T @ place
    points[:, 2] += plane.point[0]
    pixels, size = camera.matrix @ camera.axes.T @ points, grid.odds.shape[::-1]
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(labels, pixels, size, flags=flags), np.uint16)


def passed_through(
    points: NDArray[np.float64],
    offset: NDArray[np.float64],
    variance: Callable[[NDArray[np.intp]], NDArray[np.float64]],
    image: RangeImage,
    sensor: SensorModel,
) -> NDArray[np.bool_]:
    """Whether rays pass through points (K, 3) of planes; they do not where they end before.

    Points are in the frame of the image, which is that of a camera: of a cloud, nobody knows which
    pixel looks where. `offset` (K,) are the distances of their planes from it, metres; `variance`
    gives those of the points of some numbers, across their planes, square metres.
    """
    passed, camera = np.zeros(len(points), np.bool_), image.camera
    assert camera is not None
    pixel = camera.matrix @ camera.axes.T @ points.T
    ahead = np.flatnonzero(pixel[2] > 0)
    depth = pixel[2, ahead]
    column, row = np.rint(pixel[:2, ahead] / depth).astype(np.intp)
    height, width = image.shape
    shown = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    ahead, depth = ahead[shown], depth[shown]
    measured = image.inverse[row[shown], column[shown]].astype(np.float64)
    behind = (measured > 0) & (measured * depth < 1)
    k, excess, squared = ahead[behind], 1 / depth[behind] - measured[behind], depth[behind] ** -2
    error = random_variance(sensor, squared) + systematic_variance(sensor, squared)
    # Along the ray, the inverse depth changes by 1 / z for every n . p.
    error += variance(k) * squared / offset[k] ** 2
    steep = np.abs(offset[k]) > _GRAZING * np.linalg.norm(points[k], axis=1)
    passed[k] = steep & (excess > OUTLIER * np.sqrt(error))
    return passed
