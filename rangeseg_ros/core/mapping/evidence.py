"""Where a plane of the map is still there: cells of its outline that rays end at or pass."""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from rangeseg_ros.core.mapping.map_outlines import areas
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import OUTLIER

THERE, UNSEEN, THROUGH = 1, 0, -1  # what a ray says of a place
HIT, MISS, _MOST, LEAST = 0.85, -0.4, 3.5, -2.0
"""Log-odds of a ray that ends at a cell and of one that passes through it, and the bounds of their
sum, so that a cell follows a change within ten looks: Hornung et al., "OctoMap", Autonomous
Robots 2013.
"""
# Cells of a plane at most; the side of a cell is a power of two.
_CELLS = 64
# Least cosine of incidence: 3 degrees, where rays run along what they could pass through.
_GRAZING = 0.05


class Evidence:
    """Log-odds that a plane is there, in square cells of its outline.

    Attributes
    ----------
    centres : (K, 2) float64
        Of the cells, metres along the axes of the plane.
    odds : (K,) float64
    """

    def __init__(self) -> None:
        # Of an outline that was not followed yet, the one place where the plane was found first.
        self.centres = np.zeros((1, 2))
        self.odds = np.full(1, HIT)
        self._side = 0.0
        self._known: dict[tuple[int, int], int] = {}

    def circle(self) -> tuple[NDArray[np.float64], float]:
        """Middle (2,) and radius of a circle with the centres of all cells, metres."""
        if not len(self.centres):
            return np.zeros(2), 0.0
        least, most = self.centres.min(axis=0), self.centres.max(axis=0)
        return (least + most) / 2, math.dist(least, most) / 2

    def follow(self, outline: Polygon | MultiPolygon) -> None:
        """Have the cells of an outline; what is new has just been seen."""
        side = 2.0 ** math.ceil(math.log2(math.sqrt(max(outline.area, 1e-4) / _CELLS)))
        left, low, right, high = outline.bounds if not outline.is_empty else (0, 0, -1, -1)
        column = np.arange(math.floor(left / side), math.floor(right / side) + 2)
        row = np.arange(math.floor(low / side), math.floor(high / side) + 2)
        corner = shapely.contains_xy(outline, column[:, None] * side, row * side)
        # Borders are not as certain as what is within.
        whole = corner[:-1, :-1] & corner[1:, :-1] & corner[:-1, 1:] & corner[1:, 1:]
        across, along = np.nonzero(whole)
        cells = list(zip(column[across].tolist(), row[along].tolist(), strict=True))
        if not cells and not outline.is_empty:
            # A sliver between the corners of cells.
            point = outline.representative_point()
            cells = [(math.floor(point.x / side), math.floor(point.y / side))]
        before = self._known if side == self._side else {}
        odds = [self.odds[before[cell]] if cell in before else HIT for cell in cells]
        self._side, self._known = side, {cell: k for k, cell in enumerate(cells)}
        self.odds = np.array(odds, np.float64)
        self.centres = (np.array(cells, np.float64).reshape(-1, 2) + 0.5) * side

    def see(self, found: NDArray[np.int8]) -> bool:
        """Take in `find_sightings` of the cells; whether rays pass through some of them."""
        change = np.array([0.0, HIT, MISS])[found]
        self.odds = np.clip(self.odds + change, LEAST, _MOST)
        return bool((self.odds < 0).any())

    def remaining(self, outline: Polygon | MultiPolygon) -> Polygon | MultiPolygon:
        """What is left of an outline without the cells that rays pass through."""
        gone = self.odds < 0
        if gone.all():
            return Polygon()
        half = self._side / 2
        around = []
        for chosen, reach in ((~gone, 2 * half), (gone, half)):
            x, y = self.centres[chosen].T
            around.append(
                shapely.union_all(shapely.box(x - reach, y - reach, x + reach, y + reach))
            )
        return areas(outline.intersection(around[0]).difference(around[1]))


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


def find_sightings(
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
    camera = image.camera
    if camera is None:
        return found
    x, y, z = (points @ camera.axes).T
    ahead = z > 0
    depth = np.where(ahead, z, 1)
    column = np.rint(camera.fx * x / depth + camera.cx)
    row = np.rint(camera.fy * y / depth + camera.cy)
    slope = np.abs((points * normals).sum(axis=1))
    inside = ahead & (slope > _GRAZING * np.linalg.norm(points, axis=1))
    inside &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    k = np.flatnonzero(inside)
    measured = image.inverse[row[k].astype(np.intp), column[k].astype(np.intp)].astype(np.float64)
    expected = 1 / depth[k]
    squared = expected**2
    error = random_variance(sensor, squared) + systematic_variance(sensor, squared)
    # Along the ray, the inverse depth changes by 1 / z for every n . p.
    error += variance[k] * squared / slope[k] ** 2
    beyond = (expected - measured) / np.sqrt(error)
    seen = (measured > 0) & (beyond >= -OUTLIER)
    found[k[seen]] = np.where(beyond[seen] > OUTLIER, THROUGH, THERE)
    return found
