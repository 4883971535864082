"""Where the pixels of a class lie."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.ground.terrain import Terrain
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import first_rays, next_rays


def points_of_class(image: RangeImage, terrain: Terrain, kind: int) -> NDArray[np.float32]:
    """Points (N, 4) of the pixels of a class: x, y, z and height above the ground, metres.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    terrain : Terrain
        Of the image.
    kind : int
        GROUND, OBSTACLE or DROP.

    Returns
    -------
    (N, 4) float32
        In the frame of the image, in the order of the pixels.
    """
    points = np.empty((np.count_nonzero(terrain.classes == kind), 4), np.float32)
    pixels = image.inverse, image.rays, image.pinhole, image.place
    _write_points(terrain.classes, kind, terrain.height, *pixels, points)
    return points


@njit(cache=True, nogil=True, error_model='numpy')
def _write_points(
    classes: NDArray[np.uint8],
    kind: int,
    height: NDArray[np.float32],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    place: NDArray[np.float64],
    points: NDArray[np.float32],
) -> None:
    """Eight parameters, as a kernel takes arrays."""
    count = 0
    ray = first_rays(rays, 0)
    for i in range(classes.shape[0]):
        next_rays(rays, pinhole, i, ray)
        for j in range(classes.shape[1]):
            if classes[i, j] != kind:
                continue
            for k in range(3):
                points[count, k] = ray[k, j] / inverse[i, j] + place[k]
            points[count, 3] = height[i, j]
            count += 1
