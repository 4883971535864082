"""Where the pixels of a class lie, where rays cross the ground, and the outline of the ground."""

from __future__ import annotations

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Indices, Mask, Singles
from rangeseg_ros.core.description.shapes import TOLERANCE
from rangeseg_ros.core.ground.cells import DROP, GROUND
from rangeseg_ros.core.ground.terrain import Terrain
from rangeseg_ros.core.sensing.clouds import completed_rays
from rangeseg_ros.core.sensing.range_image import RangeImage


def points_of_class(image: RangeImage, terrain: Terrain, kind: int) -> Singles:
    """Points (N, 4) of the pixels of a class: x, y, z and height above the ground, metres.

    In the frame of the image (H, W), in the order of the pixels; `kind` is `GROUND`, say.
    """
    where = np.flatnonzero(terrain.classes == kind)
    points = np.empty((len(where), 4), np.float32)
    rays, inverse = image.rays.reshape(-1, 3).take(where, axis=0), image.inverse.take(where)
    # Axis by axis: broadcasting takes twice as long.
    for k, shift in enumerate(image.place.astype(np.float32)):
        np.divide(rays[:, k], inverse, out=points[:, k])
        points[:, k] += shift
    points[:, 3] = terrain.height.take(where)
    return points


def drops(image: RangeImage, terrain: Terrain) -> Singles:
    """Where the rays that end in a drop cross the ground continued, as `_ground_points`."""
    return _ground_points(image.rays, image, terrain, terrain.classes == DROP)


def unseen(image: RangeImage, terrain: Terrain) -> Singles:
    """Crossings of rays without a measurement, as `_ground_points`.

    Points lie within the least and greatest range at which measured pixels are ground or unknown,
    as sensors have a nearest and a farthest range. Pixels of the robot's body do not count, nor do
    single missing pixels, which all sensors have. Clouds have no rays of missing points: rays are
    interpolated between measured points where the grid is smooth (see `completed_rays`).
    """
    seen = image.inverse[(terrain.classes <= GROUND) & image.valid]
    missing = ~image.valid if image.body is None else ~(image.valid | image.body)
    opened = cv2.morphologyEx(missing.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    rays = image.rays
    if len(seen) and image.camera is None:
        completed = completed_rays(image.rays, image.valid)
        if completed is None:
            seen = seen[:0]
        else:
            rays = completed[0]
            opened[~completed[1]] = 0
    if not len(seen):
        return np.zeros((0, 4), np.float32)
    return _ground_points(rays, image, terrain, opened > 0, (float(seen.min()), float(seen.max())))


def _ground_points(
    rays: Singles,
    image: RangeImage,
    terrain: Terrain,
    where: Mask,
    bounds: tuple[float, float] = (0.0, np.inf),
) -> Singles:
    """Points (N, 4) where rays (H, W, 3) cross the ground continued, of the pixels `where`.

    x, y, z in the frame of the image, metres, and the height of what was measured along the ray,
    NaN where nothing was. Rays that do not cross the ground in front of the sensor are left out,
    and those for which its inverse range there is not within `bounds`, 1/m.
    """
    rows, columns = np.divmod(np.flatnonzero(where), where.shape[1])
    points, inverse = _cross(rays, image, terrain, rows, columns)
    inside = (inverse > 0) & (inverse >= bounds[0]) & (inverse <= bounds[1])
    height = terrain.height[rows[inside], columns[inside]]
    return np.column_stack([points[inside], height]).astype(np.float32)


def _cross(
    rays: Singles, image: RangeImage, terrain: Terrain, rows: Indices, columns: Indices
) -> tuple[Singles, Singles]:
    """Where rays meet the ground (N, 3), and their inverse range there, > 0 where they do."""
    theta, size = terrain.field.theta, terrain.field.size
    rays = rays[rows, columns]
    inverse = (theta[:, rows // size.rows, columns // size.columns].T * rays).sum(axis=1)
    with np.errstate(divide='ignore', invalid='ignore'):
        points = rays / inverse[:, None] + image.place
    return points.astype(np.float32), inverse


def outlines(image: RangeImage, terrain: Terrain) -> list[Singles]:
    """Closed lines (N, 3) around the ground, metres, in the frame of the image."""
    ground = (terrain.classes == GROUND).astype(np.uint8)
    rings, _ = cv2.findContours(ground, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    lines = []
    for ring in rings:
        line = cv2.approxPolyDP(ring, TOLERANCE, True)[:, 0]
        if len(line) > 2:  # holes of single pixels have no outline
            points, inverse = _cross(image.rays, image, terrain, line[:, 1], line[:, 0])
            lines.append(points[inverse > 0])
    return lines
