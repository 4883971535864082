"""Size and place of regions on their planes, worked out when an output asks for them."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.description.outlines import Outline
from rangeseg_ros.core.rotations import quaternions


class Shape(NamedTuple):
    """Size and place of a region, see `Plane`."""

    area: float
    extents: NDArray[np.float64]
    centre: NDArray[np.float64]
    orientation: NDArray[np.float64]


class Shapes:
    """Shapes of the regions of an image, all worked out when the first is asked for.

    Parameters
    ----------
    outlines : list of Outline
        Of the regions.
    place : (3,) float64
        Of the sensor in the frame of the image.
    right : (3,) float64
        To the right in the image: the longer axes point there.
    """

    def __init__(
        self, outlines: list[Outline], place: NDArray[np.float64], right: NDArray[np.float64]
    ) -> None:
        self._outlines, self._place, self._right = outlines, place, right

    def __getitem__(self, number: int) -> Shape:
        return self._shapes[number]

    @cached_property
    def _shapes(self) -> list[Shape]:
        # Contours cut the corners between pixels, and those of clouds run through the middles of
        # pixels: all pixels of a region have the mean area of those that its contours enclose.
        rectangles = [
            _rectangle(*outline.corners(), outline.theta, self._right)
            for outline in self._outlines
        ]
        pixels = [cv2.countNonZero(outline.mask.view(np.uint8)) for outline in self._outlines]
        footprint, extents, centre, frames = zip(*rectangles, strict=True)
        area = (np.array(footprint) * pixels).tolist()
        turned = quaternions(np.stack(frames))
        return list(map(Shape, area, extents, np.stack(centre) + self._place, turned))


class RegionShape:
    """Shape of one region, that of `Shapes` when read; a `Shape` in a pickle."""

    def __init__(self, shapes: Shapes, number: int) -> None:
        self._shapes, self._number = shapes, number

    def __getattr__(self, name: str) -> Any:
        return getattr(self._shapes[self._number], name)

    def __reduce__(self) -> tuple[type[Shape], Shape]:
        return Shape, self._shapes[self._number]


@njit(cache=True, error_model='numpy')
def _rectangle(
    corners: NDArray[np.float64],
    ring: NDArray[np.intp],
    theta: NDArray[np.float64],
    right: NDArray[np.float64],
) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Rectangle around a polygon, along the principal axes of its area.

    Parameters
    ----------
    corners : (N, 5) float64
        Place in the image (x, y) and ray of the corners of all rings, one ring after the other;
        holes run the other way round.
    ring : (N,) int
        Number of each corner's ring.
    theta : (3,) float64
        Plane, theta . ray = inverse range.
    right : (3,) float64
        Direction to whose side the longer axis points.

    Returns
    -------
    footprint : float
        Square metres of a pixel.
    extents : (2,) float64
    centre : (3,) float64
    frame : (3, 3) float64
        Directions of length, width and normal, as columns.
    """
    places, rays = corners[:, :2], corners[:, 2:]
    level = rays[:, 0] * theta[0] + rays[:, 1] * theta[1] + rays[:, 2] * theta[2]
    points = rays / level.reshape(-1, 1)
    normal = -theta / np.sqrt((theta * theta).sum())
    count = len(points)
    across = np.zeros(3)
    across[np.argmin(np.abs(normal))] = 1.0
    first = np.cross(normal, across)
    first /= np.sqrt((first * first).sum())
    second = np.cross(normal, first)
    # Around the first corner, so that the products keep their digits.
    x, y = np.zeros(count), np.zeros(count)
    for k in range(count):
        for a in range(3):
            x[k] += first[a] * (points[k, a] - points[0, a])
            y[k] += second[a] * (points[k, a] - points[0, a])
    # Green's theorem: twice the areas, six times the first, 12 and 24 times the second moments.
    area = inside = mx = my = xx = xy = yy = 0.0
    start = 0
    for k in range(count):
        if ring[k] != ring[start]:
            start = k
        n = k + 1 if k + 1 < count and ring[k + 1] == ring[k] else start
        inside += places[k, 0] * places[n, 1] - places[n, 0] * places[k, 1]
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
    cosine, sine = np.cos(turn), np.sin(turn)
    if cosine * (first * right).sum() + sine * (second * right).sum() < 0:
        cosine, sine = -cosine, -sine
    along, up = cosine * x + sine * y, cosine * y - sine * x
    frame = np.empty((3, 3))
    frame[:, 0], frame[:, 1] = cosine * first + sine * second, cosine * second - sine * first
    frame[:, 2] = normal
    middle = (along.min() + along.max()) / 2, (up.min() + up.max()) / 2
    centre = points[0] + middle[0] * frame[:, 0] + middle[1] * frame[:, 1]
    extents = np.array([along.max() - along.min(), up.max() - up.min()])
    footprint = abs(area / inside) if inside != 0 else 0.0
    return footprint, extents, centre, frame
