"""Outlines of regions on their planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from mapbox_earcut import triangulate_float64
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera

TOLERANCE = 1.5
"""Distance of the polygon from the outline at most, pixels: what segmentation leaves open."""


# Of the largest component of a plane's theta; a ray whose inverse range is less grazes the plane.
_GRAZING = 1e-3
# The pixels that a corner belongs to.
_CORNERS = np.ones((2, 2), np.uint8)


@dataclass(eq=False)
class Outline:
    """Border of a region, put on its plane when first asked for.

    Attributes
    ----------
    labels : (h, w) uint16
        Those of its bounding box.
    label : int
        The region's.
    row, column : int
        Of the box's first pixel in the image.
    theta : (3,) float64
        Plane, theta . ray = inverse range.
    rays : Camera or (h, w, 3) float32
        What gives the rays: of the corners of the pixels (camera), or of their centres (cloud).
    """

    labels: NDArray[np.uint16]
    label: int
    row: int
    column: int
    theta: NDArray[np.float64]
    rays: Camera | NDArray[np.float32]

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """(h, w) the region in its bounding box."""
        return self.labels == self.label

    @property
    def hull(self) -> NDArray[np.float64]:
        """(N, 3) outer border of the largest part, counter-clockwise seen from the sensor."""
        return self._rings[0]

    @property
    def holes(self) -> list[NDArray[np.float64]]:
        """Borders (N, 3) of the holes in the largest part, clockwise seen from the sensor."""
        return self._rings[1]

    @property
    def parts(self) -> list[list[NDArray[np.float64]]]:
        """Hull and holes of each part: of the largest one."""
        return [[self.hull, *self.holes]]

    def exists(self) -> bool:
        """Whether there is a polygon: steep planes may lie behind the sensor at their border."""
        return len(self.hull) > 2 and bool(np.isfinite(self.hull).all())

    @cached_property
    def _rings(self) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        # A pixel covers its four corners. On this lattice, contours run along the sides of the
        # pixels, those of holes too, and holes of single pixels close.
        room = cv2.copyMakeBorder(self.mask.view(np.uint8), 0, 1, 0, 1, cv2.BORDER_CONSTANT)
        lattice = cv2.dilate(room, _CORNERS, anchor=(1, 1))
        contours, tree = cv2.findContours(lattice, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        # Each with the number of the border around it, -1 for outer ones.
        rings = list(zip(contours, tree[0, :, 3].tolist(), strict=True))
        outer = max(
            (k for k, (_, parent) in enumerate(rings) if parent < 0),
            key=lambda k: cv2.contourArea(rings[k][0]),
        )
        holes = [self._on_plane(ring) for ring, parent in rings if parent == outer]
        return self._on_plane(rings[outer][0]), [hole for hole in holes if len(hole) > 2]

    def _on_plane(self, contour: NDArray[Any]) -> NDArray[np.float64]:
        # Contours run counter-clockwise on the screen, x right and y down, and so does the
        # sensor see them.
        corners = cv2.approxPolyDP(contour, TOLERANCE, True)[:, 0]
        if len(corners) < 3:  # of regions no wider than the tolerance nothing would be left
            corners = contour[:, 0]
        rays = self._rays(corners)
        level = rays @ self.theta
        # Grazing planes end in the distance.
        ahead = level > _GRAZING * np.abs(self.theta).max()
        if not ahead.all():
            rays, level = rays[ahead], level[ahead]
        points: NDArray[np.float64] = rays / level[:, None]
        return points + self.rays.place if isinstance(self.rays, Camera) else points

    def _rays(self, corners: NDArray[Any]) -> NDArray[np.float64]:
        """Rays (N, 3) of corners (x, y) of pixels in the box."""
        if isinstance(self.rays, Camera):
            left, top = self.column - 0.5, self.row - 0.5
            return self.rays.rays_at(corners[:, 0] + left, corners[:, 1] + top)
        total = np.zeros((len(corners), 3))
        height, width = self.mask.shape
        for i in (0, -1):
            for j in (0, -1):
                row = np.clip(corners[:, 1] + i, 0, height - 1)
                column = np.clip(corners[:, 0] + j, 0, width - 1)
                total += self.rays[row, column] * self.mask[row, column, None]
        return total / np.linalg.norm(total, axis=1, keepdims=True)


def lies_ahead(
    boxes: NDArray[np.intp], theta: NDArray[np.float64], camera: Camera | None
) -> NDArray[np.bool_]:
    """Which regions surely have finite outlines (N,): those of a pinhole camera whose box does.

    All of a box lies ahead where its corners do.

    Parameters
    ----------
    boxes : (N, 4) int
        First row and column of each region, and the ones after its last.
    theta : (N, 3) float64
        Planes, theta . ray = inverse range.
    camera : Camera or None
        None for an organised cloud.
    """
    if camera is None or not camera.pinhole:
        return np.zeros(len(boxes), np.bool_)
    corners = np.stack([boxes[:, [1, 3, 1, 3]], boxes[:, [0, 0, 2, 2]]], axis=-1) - 0.5
    level = np.einsum('nki,ni->nk', camera.rays_at(corners[..., 0], corners[..., 1]), theta)
    ahead: NDArray[np.bool_] = level.min(axis=1) > _GRAZING * np.abs(theta).max(axis=1)
    return ahead


def triangles(
    rings: Sequence[NDArray[np.float64]], normal: NDArray[np.float64]
) -> NDArray[np.intp]:
    """Triangles of a polygon with holes, counter-clockwise seen from where its normal points.

    Parameters
    ----------
    rings : sequence of (N, 3) float64
        Border and holes.
    normal : (3,) float64

    Returns
    -------
    (T, 3) int
        Numbers of corners, those of all rings counted on.
    """
    corners = np.concatenate(rings)
    # Seen along the axis nearest to the normal, from the side that it points to.
    axis = int(np.abs(normal).argmax())
    right, up = (axis + 1) % 3, (axis + 2) % 3
    flat = np.take(corners, (right, up) if normal[axis] > 0 else (up, right), axis=1)
    ends = np.cumsum([len(ring) for ring in rings], dtype=np.uint32)
    return triangulate_float64(flat, ends).astype(np.intp).reshape(-1, 3)
