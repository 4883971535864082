"""Outlines of regions on their planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from mapbox_earcut import triangulate_float64
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera

TOLERANCE = 1.5
"""Distance of the polygon from the outline at most, pixels: what segmentation leaves open."""

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
    farthest : float
        Least inverse range on the plane that counts: steep planes end in the distance.
    rays : Camera or (h, w, 3) float32
        What gives the rays: of the corners of the pixels (camera), or of their centres (cloud).
    """

    labels: NDArray[np.uint16]
    label: int
    row: int
    column: int
    theta: NDArray[np.float64]
    farthest: float
    rays: Camera | NDArray[np.float32]

    def __getstate__(self) -> dict[str, Any]:
        # Without what it has worked out.
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """(h, w) the region in its bounding box."""
        return self.labels == self.label

    @cached_property
    def hull(self) -> NDArray[np.float64]:
        """(N, 3) outer border of the largest part, counter-clockwise seen from the sensor."""
        return self._simplified(self._contours[0][self._largest])

    @cached_property
    def holes(self) -> list[NDArray[np.float64]]:
        """Borders (N, 3) of the holes in the largest part, clockwise seen from the sensor."""
        inside = np.flatnonzero(self._contours[1] == self._largest).tolist()
        holes = [self._simplified(self._contours[0][k]) for k in inside]
        return [hole for hole in holes if len(hole) > 2]

    @property
    def parts(self) -> list[list[NDArray[np.float64]]]:
        """Hull and holes of each part: of the largest one."""
        return [[self.hull, *self.holes]]

    def corners(self) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Of all rings, place in the image and ray (N, 5), and number of the ring (N,)."""
        contours = self._contours[0]
        corners = self._rays(np.concatenate(contours))
        length = [len(contour) for contour in contours]
        if not (corners[:, 2:] @ self.theta >= self.farthest).all():
            rings = list(map(self._clipped, np.split(corners, np.cumsum(length)[:-1])))
            corners, length = np.concatenate(rings), [len(ring) for ring in rings]
        return corners, np.repeat(np.arange(len(length)), length)

    @cached_property
    def _contours(self) -> tuple[list[NDArray[np.int32]], NDArray[Any]]:
        """Borders (N, 2) on the lattice of corners, and the number of the one around each, or -1.

        A pixel covers its four corners: contours run along the sides of the pixels, those of holes
        too, and holes of single pixels close. On the screen, x right and y down, they run
        counter-clockwise, and so does the sensor see them.
        """
        room = cv2.copyMakeBorder(self.mask.view(np.uint8), 0, 1, 0, 1, cv2.BORDER_CONSTANT)
        lattice = cv2.dilate(room, _CORNERS, anchor=(1, 1))
        contours, tree = cv2.findContours(lattice, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        return [np.asarray(contour[:, 0], np.int32) for contour in contours], tree[0, :, 3]

    @cached_property
    def _largest(self) -> int:
        """Number of the contour around the largest part."""
        contours, around = self._contours
        outer = np.flatnonzero(around < 0).tolist()
        return max(outer, key=lambda k: cv2.contourArea(contours[k]))

    def _simplified(self, contour: NDArray[np.int32]) -> NDArray[np.float64]:
        """Points (N, 3) on the plane of a contour without the corners that say little."""
        corners = np.asarray(cv2.approxPolyDP(contour, TOLERANCE, True)[:, 0], np.int32)
        rays = self._clipped(self._rays(corners))[:, 2:]
        # Of regions no wider than the tolerance, or with few corners that have a ray, all count.
        if len(rays) < 3:
            rays = self._clipped(self._rays(contour))[:, 2:]
        points: NDArray[np.float64] = rays / (rays @ self.theta)[:, None]
        return points + self.rays.place if isinstance(self.rays, Camera) else points

    def _clipped(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """A ring (N, 5) of places and rays as far as its plane counts (Sutherland and Hodgman)."""
        level = corners[:, 2:] @ self.theta - self.farthest
        # Lenses that fold the image leave corners without a ray.
        corners, level = corners[np.isfinite(level)], level[np.isfinite(level)]
        kept = level >= 0
        if kept.all():
            return corners
        after, later = np.roll(corners, -1, axis=0), np.roll(level, -1)
        ends = np.flatnonzero(kept != np.roll(kept, -1))
        share = (level[ends] / (level[ends] - later[ends]))[:, None]
        crossing = corners[ends] + share * (after[ends] - corners[ends])
        order = np.argsort(np.append(np.flatnonzero(kept), ends + 0.5), kind='stable')
        return np.concatenate([corners[kept], crossing])[order]

    def _rays(self, corners: NDArray[np.int32]) -> NDArray[np.float64]:
        """Places (x, y) in the image and rays (N, 5) of corners (x, y) of pixels in the box."""
        if isinstance(self.rays, Camera):
            places = corners + np.array([self.column - 0.5, self.row - 0.5])
            return np.hstack([places, self.rays.rays_at(places[:, 0], places[:, 1])])
        total = np.zeros((len(corners), 6))
        height, width = self.mask.shape
        for i in (0, -1):
            for j in (0, -1):
                row = np.clip(corners[:, 1] + i, 0, height - 1)
                column = np.clip(corners[:, 0] + j, 0, width - 1)
                values = np.column_stack([column, row, self.rays[row, column], np.ones(len(row))])
                total += values * self.mask[row, column, None]
        return total[:, :5] / total[:, 5:]


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
