"""Where the ground ends: rays that cross it without being stopped, and its outline."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.classes import DROP, GROUND
from rangeseg_ros.core.meaning.ground import Terrain
from rangeseg_ros.core.meaning.ground_field import GroundField, plane_at
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.rays import completed_rays

# Pixels that an outline may differ from the border of the ground.
_TOLERANCE = 2.0


def find_crossings(image: RangeImage, terrain: Terrain, where: NDArray[np.bool_]) -> NDArray:
    """Points where rays cross the ground continued.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    terrain : Terrain
    where : (H, W) bool
        Which rays; those that do not cross the ground in front of the sensor are left out.

    Returns
    -------
    (N, 4) float32
        x, y, z in the frame of the image, metres, and the height of what was measured along the
        ray, NaN where nothing was.
    """
    inverse = np.zeros(image.shape, np.float32)
    run_rows(_ground_inverse, image.shape[0], image.rays, terrain.field, inverse)
    chosen = where & (inverse > 0)
    points = image.rays[chosen] / inverse[chosen, None]
    return np.column_stack([points, terrain.height[chosen]]).astype(np.float32)


def drops(image: RangeImage, terrain: Terrain) -> NDArray[np.float32]:
    """Crossings (N, 4) of the rays that end in a drop, as `find_crossings`."""
    return find_crossings(image, terrain, terrain.classes == DROP)


def unseen(image: RangeImage, terrain: Terrain) -> NDArray[np.float32]:
    """Crossings (N, 4) of rays without a measurement, as `find_crossings`.

    As far as ground is seen and not nearer: no sensor sees below its own nearest or farthest
    range. Not where the robot's own body is in the way. Single pixels do not count: sensors miss
    some everywhere. Clouds do not tell the rays of what they have not measured: those between
    measured points, where their grid is smooth (see `completed_rays`).
    """
    seen = terrain.classes == GROUND
    missing = ~image.valid if image.body is None else ~(image.valid | image.body)
    opened = cv2.morphologyEx(missing.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if not seen.any():
        return np.zeros((0, 4), np.float32)
    if image.camera is None:
        completed = completed_rays(image)
        if completed is None:
            return np.zeros((0, 4), np.float32)
        rays = completed[0]
        rays.flags.writeable = False  # as all rays are, or every kernel is compiled twice
        image = replace(image, rays=rays)
        opened[~completed[1]] = 0
    found = find_crossings(image, terrain, opened > 0)
    nearest, farthest = 1 / image.inverse[seen].max(), 1 / image.inverse[seen].min()
    # Clouds measure along their rays, images along the optical axis.
    depth = found[:, 2] if image.camera else np.linalg.norm(found[:, :3], axis=1)
    return found[(depth >= nearest) & (depth <= farthest)]


def outlines(image: RangeImage, terrain: Terrain) -> list[NDArray[np.float32]]:
    """Closed lines (N, 3) around the ground, metres, in the frame of the image."""
    ground = (terrain.classes == GROUND).astype(np.uint8)
    rings, _ = cv2.findContours(ground, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    inverse = np.zeros(image.shape, np.float32)
    run_rows(_ground_inverse, image.shape[0], image.rays, terrain.field, inverse)
    lines = []
    for ring in rings:
        columns, rows = cv2.approxPolyDP(ring, _TOLERANCE, True)[:, 0].T
        if len(rows) > 2:  # holes of single pixels have no outline
            values = inverse[rows, columns]
            ahead = values > 0
            lines.append(image.rays[rows, columns][ahead] / values[ahead, None])
    return lines


@njit(cache=True, nogil=True)
def _ground_inverse(
    first: int,
    after: int,
    rays: NDArray[np.float32],
    field: GroundField,
    inverse: NDArray[np.float32],
) -> None:
    """Inverse range at which rays cross the ground; not positive where they do not."""
    for i in range(first, after):
        for j in range(rays.shape[1]):
            theta = plane_at(field, i, j)
            ray = rays[i, j]
            inverse[i, j] = theta[0] * ray[0] + theta[1] * ray[1] + theta[2] * ray[2]
