"""Where the ground ends: rays that cross it without being stopped, and its outline."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.ground.classes import DROP, GROUND
from rangeseg_ros.core.ground.field import GroundField, plane_at
from rangeseg_ros.core.ground.terrain import Terrain
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.rays import completed_rays

# Pixels that an outline may differ from the border of the ground.
_TOLERANCE = 2.0


def find_crossings(
    image: RangeImage,
    terrain: Terrain,
    where: NDArray[np.bool_],
    bounds: tuple[float, float] = (0.0, np.inf),
) -> NDArray[np.float32]:
    """Points where rays cross the ground continued.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    terrain : Terrain
    where : (H, W) bool
        Which rays; those that do not cross the ground in front of the sensor are left out.
    bounds : (float, float)
        Least and largest inverse range of the ground at a crossing, 1/m.

    Returns
    -------
    (N, 4) float32
        x, y, z in the frame of the image, metres, and the height of what was measured along the
        ray, NaN where nothing was.
    """
    found = _cross(image.rays, where, terrain.height, terrain.field, bounds)
    found[:, :3] += image.place
    return found


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
    bounds = _extremes(image.inverse, seen)
    if bounds[1] == 0:
        return np.zeros((0, 4), np.float32)
    if image.camera is None:
        completed = completed_rays(image)
        if completed is None:
            return np.zeros((0, 4), np.float32)
        rays = completed[0]
        rays.flags.writeable = False  # as all rays are, or every kernel is compiled twice
        image = replace(image, rays=rays)
        opened[~completed[1]] = 0
    return find_crossings(image, terrain, opened > 0, bounds)


def outlines(image: RangeImage, terrain: Terrain) -> list[NDArray[np.float32]]:
    """Closed lines (N, 3) around the ground, metres, in the frame of the image."""
    ground = (terrain.classes == GROUND).astype(np.uint8)
    rings, _ = cv2.findContours(ground, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    lines = []
    for ring in rings:
        line = cv2.approxPolyDP(ring, _TOLERANCE, True)[:, 0]
        if len(line) > 2:  # holes of single pixels have no outline
            lines.append(_cross_at(image.rays, line, terrain.field))
            lines[-1] += image.place
    return lines


@njit(cache=True, inline='always')
def _inverse(field: GroundField, rays: NDArray[np.float32], i: int, j: int) -> np.float32:
    """Inverse range at which a ray crosses the ground; not positive where it does not."""
    x, y, z = plane_at(field, i, j)
    return np.float32(x * rays[i, j, 0] + y * rays[i, j, 1] + z * rays[i, j, 2])


@njit(cache=True, nogil=True)
def _cross(
    rays: NDArray[np.float32],
    where: NDArray[np.bool_],
    height: NDArray[np.float32],
    field: GroundField,
    bounds: tuple[float, float],
) -> NDArray[np.float32]:
    """See `find_crossings`."""
    number = np.zeros(len(where), np.int64)
    for i in range(len(where)):
        for j in range(where.shape[1]):  # as vector instructions
            number[i] += where[i, j]
    found = np.empty((number.sum(), 4), np.float32)
    count = 0
    for i in range(len(where)):
        if number[i] == 0:
            continue
        for j in range(where.shape[1]):
            if where[i, j]:
                value = _inverse(field, rays, i, j)
                if value > 0 and bounds[0] <= value <= bounds[1]:
                    for n in range(3):
                        found[count, n] = rays[i, j, n] / value
                    found[count, 3] = height[i, j]
                    count += 1
    return found[:count]


@njit(cache=True, nogil=True)
def _cross_at(
    rays: NDArray[np.float32], pixels: NDArray[np.int32], field: GroundField
) -> NDArray[np.float32]:
    """The same of some pixels (N, 2), each a column and a row."""
    found = np.empty((len(pixels), 3), np.float32)
    count = 0
    for j, i in pixels:
        value = _inverse(field, rays, i, j)
        if value > 0:
            for n in range(3):
                found[count, n] = rays[i, j, n] / value
            count += 1
    return found[:count]


@njit(cache=True, nogil=True)
def _extremes(inverse: NDArray[np.float32], where: NDArray[np.bool_]) -> tuple[float, float]:
    """Least and largest of some pixels' inverse range; inf, 0 where there are none."""
    low = np.full(inverse.shape[1], np.float32(np.inf))
    high = np.zeros(inverse.shape[1], np.float32)
    for i in range(inverse.shape[0]):
        for j in range(inverse.shape[1]):  # as vector instructions
            value = inverse[i, j]
            low[j] = min(low[j], value) if where[i, j] else low[j]
            high[j] = max(high[j], value) if where[i, j] else high[j]
    return float(low.min()), float(high.max())
