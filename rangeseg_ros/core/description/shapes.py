"""Outlines and sizes of regions on their planes, worked out when an output asks for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from mapbox_earcut import triangulate_float64
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Ints, Labels, Mask, Singles
from rangeseg_ros.core.sensing.camera import Camera

# Distance of the polygon from the outline at most, pixels: what segmentation leaves open.
TOLERANCE = 1.5
_CORNERS = np.ones((2, 2), np.uint8)  # the pixels that a corner belongs to


@dataclass(eq=False)
class Outline:
    """Border of a region, put on its plane when first asked for."""

    labels: Labels  # (h, w), of its bounding box
    label: int
    row: int  # of the box's first pixel in the image
    column: int
    theta: Floats  # plane, theta . ray = inverse range
    farthest: float  # inverse range at which a steep plane ends
    # What gives the rays: of the corners of the pixels, or (h, w, 3) of their centres (cloud).
    rays: Camera | Singles

    def __getstate__(self) -> dict[str, Any]:
        # Without what it has worked out.
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def mask(self) -> Mask:
        """(h, w) the region in its bounding box."""
        return self.labels == self.label

    @cached_property
    def hull(self) -> Floats:
        """(N, 3) outer border of the largest part, counter-clockwise seen from the sensor."""
        return self._simplified(self._contours[0][self._largest])

    @cached_property
    def holes(self) -> list[Floats]:
        """Borders (N, 3) of the holes in the largest part, clockwise seen from the sensor."""
        inside = np.flatnonzero(self._contours[1] == self._largest).tolist()
        holes = [self._simplified(self._contours[0][k]) for k in inside]
        return [hole for hole in holes if len(hole) > 2]

    @property
    def parts(self) -> list[list[Floats]]:
        """Hull and holes of each part: of the largest one."""
        return [[self.hull, *self.holes]]

    def corners(self) -> tuple[Floats, Indices]:
        """Of all rings, place in the image and ray (N, 5), and number of the ring (N,)."""
        contours = self._contours[0]
        corners = self._rays(np.concatenate(contours))
        length = [len(contour) for contour in contours]
        if not (corners[:, 2:] @ self.theta >= self.farthest).all():
            rings = list(map(self._clipped, np.split(corners, np.cumsum(length)[:-1])))
            corners, length = np.concatenate(rings), [len(ring) for ring in rings]
        return corners, np.repeat(np.arange(len(length)), length)

    @cached_property
    def _contours(self) -> tuple[list[Ints], NDArray[Any]]:
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

    def _simplified(self, contour: Ints) -> Floats:
        """Points (N, 3) on the plane of a contour without the corners that say little."""
        corners = np.asarray(cv2.approxPolyDP(contour, TOLERANCE, True)[:, 0], np.int32)
        rays = self._clipped(self._rays(corners))[:, 2:]
        # Of regions no wider than the tolerance, or with few corners that have a ray, all count.
        if len(rays) < 3:
            rays = self._clipped(self._rays(contour))[:, 2:]
        points: Floats = rays / (rays @ self.theta)[:, None]
        return points + self.rays.place if isinstance(self.rays, Camera) else points

    def _clipped(self, corners: Floats) -> Floats:
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

    def _rays(self, corners: Ints) -> Floats:
        """Places (x, y) in the image and rays (N, 5) of corners (x, y) of pixels in the box."""
        if isinstance(self.rays, Camera):
            places = corners + np.array([self.column - 0.5, self.row - 0.5])
            return np.concatenate([places, self.rays.rays_at(*places.T)], axis=1)
        total = np.zeros((len(corners), 6))
        height, width = self.mask.shape
        for i in (0, -1):
            for j in (0, -1):
                row = np.clip(corners[:, 1] + i, 0, height - 1)
                column = np.clip(corners[:, 0] + j, 0, width - 1)
                values = np.column_stack([column, row, self.rays[row, column], np.ones(len(row))])
                total += values * self.mask[row, column, None]
        return total[:, :5] / total[:, 5:]


class Shape(NamedTuple):
    """Size and place of a region, see `Plane`; columns of `frame` are length, width, normal."""

    area: float
    extents: Floats
    centre: Floats
    frame: Floats


class RegionShape:
    """Shape of a region, worked out when first read; a `Shape` in a pickle.

    In the frame in which the sensor is at `place` (3,) and looks with `right` (3,) to the right.
    """

    def __init__(self, outline: Outline, place: Floats, right: Floats) -> None:
        self._outline, self._place, self._right = outline, place, right

    @cached_property
    def _shape(self) -> Shape:
        outline = self._outline
        footprint, extents, centre, frame = _rectangle(
            *outline.corners(), outline.theta, self._right
        )
        # Contours cut the corners between pixels, and those of clouds run through the middles of
        # pixels: all pixels of a region have the mean area of those that its contours enclose.
        area = footprint * cv2.countNonZero(outline.mask.view(np.uint8))
        return Shape(area, extents, centre + self._place, frame)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._shape, name)

    def __reduce__(self) -> tuple[type[Shape], Shape]:
        return Shape, self._shape


def triangles(rings: Sequence[Floats], normal: Floats) -> Indices:
    """Triangles (T, 3) of a polygon with holes, as numbers of the corners of all rings (N, 3).

    Counter-clockwise seen from where the normal points.
    """
    corners = np.concatenate(rings)
    # Seen along the axis nearest to the normal, from the side that it points to.
    axis = int(np.abs(normal).argmax())
    right, up = (axis + 1) % 3, (axis + 2) % 3
    flat = np.take(corners, (right, up) if normal[axis] > 0 else (up, right), axis=1)
    ends = np.cumsum([len(ring) for ring in rings], dtype=np.uint32)
    return triangulate_float64(flat, ends).astype(np.intp).reshape(-1, 3)


@njit(cache=True, error_model='numpy')
def _rectangle(
    corners: Floats, ring: Indices, theta: Floats, right: Floats
) -> tuple[float, Floats, Floats, Floats]:
    """Rectangle around a polygon, along the principal axes of its area, to the right.

    The corners are those of `Outline.corners`; holes run the other way round. Square metres of a
    pixel, extents (2,), centre (3,), and directions of length, width and normal as columns (3, 3).
    """
    # Numbers and loops: expressions of arrays take seconds to compile.
    count, size = len(corners), np.sqrt(theta[0] ** 2 + theta[1] ** 2 + theta[2] ** 2)
    p, q, r = -theta[0] / size, -theta[1] / size, -theta[2] / size
    # Two directions across the normal, see `plane_errors.tangents`.
    sign = 1.0 if r >= 0 else -1.0
    m = -1 / (sign + r)
    first = 1 + sign * p * p * m, sign * p * q * m, -sign * p
    second = p * q * m, sign + q * q * m, -q
    x, y, origin = np.empty(count), np.empty(count), np.empty(3)
    for k in range(count):
        a, b, c = corners[k, 2], corners[k, 3], corners[k, 4]
        level = a * theta[0] + b * theta[1] + c * theta[2]
        a, b, c = a / level, b / level, c / level
        if k == 0:
            origin[0], origin[1], origin[2] = a, b, c
        # Around the first corner, so that the products keep their digits.
        a, b, c = a - origin[0], b - origin[1], c - origin[2]
        x[k] = first[0] * a + first[1] * b + first[2] * c
        y[k] = second[0] * a + second[1] * b + second[2] * c
    # Green's theorem: twice the areas, six times the first, 12 and 24 times the second moments.
    area = inside = mx = my = xx = xy = yy = 0.0
    start = 0
    for k in range(count):
        if ring[k] != ring[start]:
            start = k
        n = k + 1 if k + 1 < count and ring[k + 1] == ring[k] else start
        inside += corners[k, 0] * corners[n, 1] - corners[n, 0] * corners[k, 1]
        cross = x[k] * y[n] - x[n] * y[k]
        area += cross
        mx += (x[k] + x[n]) * cross
        my += (y[k] + y[n]) * cross
        xx += (x[k] * x[k] + x[k] * x[n] + x[n] * x[n]) * cross
        yy += (y[k] * y[k] + y[k] * y[n] + y[n] * y[n]) * cross
        xy += (x[k] * (2 * y[k] + y[n]) + x[n] * (2 * y[n] + y[k])) * cross
    turn = 0.0
    if area != 0:
        mx, my = mx / (3 * area), my / (3 * area)
        sxx, syy = xx / (6 * area) - mx * mx, yy / (6 * area) - my * my
        turn = 0.5 * np.arctan2(2 * (xy / (12 * area) - mx * my), sxx - syy)
    cosine, sine, ahead, aside = np.cos(turn), np.sin(turn), 0.0, 0.0
    for a in range(3):
        ahead, aside = ahead + first[a] * right[a], aside + second[a] * right[a]
    if cosine * ahead + sine * aside < 0:
        cosine, sine = -cosine, -sine
    left = low = np.inf
    most = high = -np.inf
    for k in range(count):
        along, up = cosine * x[k] + sine * y[k], cosine * y[k] - sine * x[k]
        left, most, low, high = min(left, along), max(most, along), min(low, up), max(high, up)
    frame, centre = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        one, other = first[a], second[a]
        frame[a, 0], frame[a, 1] = cosine * one + sine * other, cosine * other - sine * one
        frame[a, 2] = (p, q, r)[a]
        centre[a] = origin[a] + (left + most) / 2 * frame[a, 0] + (low + high) / 2 * frame[a, 1]
    extents = np.array([most - left, high - low])
    return abs(area / inside) if inside != 0 else 0.0, extents, centre, frame
