"""Where a plane of a map is, or where the ground is free: occupancy grids.

References
----------
A. Elfes, "Using occupancy grids for mobile robot perception and navigation", Computer 1989.
A. Hornung et al., "OctoMap", Autonomous Robots 2013: log-odds with bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Floats, Indices, Labels, Mask, Singles
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.observations import PlaneSet
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import ODDS, OUTLIER

SURE = 2.0
"""Least log-odds of a cell that is sure."""
# Largest number of cells of a grid: those of larger ones get twice the side, to save memory.
_CELLS = 2**18
# Fractional bits of coordinates in OpenCV's polygons.
_BITS = 8

# Least cosine of incidence: 3 degrees, where rays run along what they could pass through.
_GRAZING = 0.05

Polygon = Sequence[Floats]
"""Border (N, 2) and borders of holes, metres along the axes of a plane."""


class PlaneGrid:
    """Log-odds that a plane is there, in square cells of a side, metres, along its axes.

    `odds` (V, U) float32 are 0 where nothing is known, rows along the second axis; `first` (2,)
    are the numbers of the first cell along both axes. From `most` cells on, they become twice as
    large. `area`, square metres, is where the plane is, `sure_area` where it surely is.
    """

    def __init__(self, side: float, most: float = _CELLS) -> None:
        self.side, self._most = side, most
        self.odds = np.zeros((0, 0), np.float32)
        self.first = np.zeros(2, np.intp)
        self._whole: PlaneGrid | None = None
        self._measure()

    def _measure(self) -> None:
        """Count cells where the plane is, as most planes of a map do not change."""
        # Surely: seen three times, or as much oftener.
        self._there = int(np.count_nonzero(self.odds > 0))
        self._sure = int(np.count_nonzero(self.odds >= SURE))

    @property
    def area(self) -> float:
        return self._there * self.side**2

    @property
    def sure_area(self) -> float:
        return self._sure * self.side**2

    def centres(self, chosen: Mask | None = None) -> Floats:
        """Centres (K, 2) of the cells where the plane is, or of those chosen (V, U)."""
        v, u = np.nonzero(self.odds > 0 if chosen is None else chosen)
        return np.asarray((np.stack([u, v], axis=1) + self.first + 0.5) * self.side, np.float64)

    def distance(self, point: Floats, limit: float) -> float:
        """From a point (2,) to the next cell where the plane is, metres; 0 inside.

        Beyond the limit it may be infinity.
        """
        (v,), (u,) = self.cells(point[None])
        height, width = self.odds.shape
        if 0 <= u < width and 0 <= v < height and self.odds[v, u] > 0:
            return 0.0
        if max(-u, u - width, -v, v - height) * self.side > limit + self.side:
            return np.inf
        return float(np.hypot(*(self.centres() - point).T).min(initial=np.inf))

    def cells(self, points: Floats) -> tuple[Indices, Indices]:
        """Rows (K,) and columns (K,) of the cells that points (K, 2) are in."""
        u, v = (np.floor(points / self.side).astype(np.intp) - self.first).T
        return v, u

    def fill(self, parts: Sequence[Polygon]) -> Mask:
        """Cells (V, U) all of whose corners are in a polygon; of slivers, one in their middle."""
        if not parts:
            return np.zeros(self.odds.shape, np.bool_)
        self.extend_to(np.concatenate([ring for part in parts for ring in part]))
        height, width = self.odds.shape
        lattice = np.zeros((height + 1, width + 1), np.uint8)
        for part in parts:
            rings = [np.rint((r / self.side - self.first) * 2**_BITS).astype(int) for r in part]
            cv2.fillPoly(lattice, [ring.astype(np.int32) for ring in rings], 1, shift=_BITS)
        inside = cv2.erode(lattice, np.ones((2, 2), np.uint8), anchor=(0, 0))[:-1, :-1] > 0
        if not inside.any():
            inside[self.cells(np.mean(parts[0][0], axis=0, keepdims=True))] = True
        return inside

    def add(self, cells: Mask, change: float) -> None:
        """Take in a look, `HIT` or `MISS`, at cells (V, U)."""
        if cells.any():
            there, sure = self._there, self._sure
            self.odds[cells] = np.clip(self.odds[cells] + change, *ODDS)
            self._measure()
            if self._whole:
                self._whole._there += self._there - there
                self._whole._sure += self._sure - sure

    def part(self, start: Indices, end: Indices) -> PlaneGrid:
        """The cells from the column and row `start` (2,) to before `end` (2,), shared."""
        part = copy(self)
        part.odds = self.odds[start[1] : end[1], start[0] : end[0]]
        part.first, part._whole = self.first + start, self
        part._measure()
        return part

    def absorb(self, centres: Floats, odds: Singles) -> None:
        """Take in cells (K, 2) of another grid, with their odds (K,), on this plane."""
        self.extend_to(centres)
        np.maximum.at(self.odds, self.cells(centres), odds)
        self._measure()

    def polygons(self) -> list[Polygon]:
        """Outlines of the parts, largest first, counter-clockwise, holes clockwise."""
        # Gaps of a cell are closed.
        room = cv2.copyMakeBorder((self.odds > 0).view(np.uint8), 2, 2, 2, 2, cv2.BORDER_CONSTANT)
        room = cv2.morphologyEx(room, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        # The corners of the cells, so that borders run along their sides.
        lattice = cv2.dilate(room, np.ones((2, 2), np.uint8), anchor=(1, 1))
        contours, tree = cv2.findContours(lattice, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        order = sorted(range(len(contours)), key=lambda k: -cv2.contourArea(contours[k]))
        # Contours run counter-clockwise with the rows downwards, thus clockwise here.
        rings = [cv2.approxPolyDP(c, 1.0, True)[::-1, 0] for c in contours]
        placed = [np.asarray((r + self.first - 2) * self.side, np.float64) for r in rings]
        kept = [k for k in order if len(rings[k]) > 2]
        parents = [int(tree[0, k, 3]) for k in range(len(contours))]
        return [
            [placed[k], *(placed[m] for m in kept if parents[m] == k)]
            for k in kept
            if parents[k] < 0
        ]

    def extend_to(self, points: Floats) -> None:
        """Extend the grid to points (N, 2), one at least."""
        least, most = points.min(axis=0), points.max(axis=0)
        low, high = (np.floor(end / self.side).astype(np.intp) for end in (least, most))
        last = self.first + self.odds.shape[::-1]
        if not self.odds.size:
            self.first = last = low
        before, after = np.maximum(self.first - low, 0), np.maximum(high + 1 - last, 0)
        if not (before.any() or after.any()):
            return
        if np.prod(last + after - self.first + before) > self._most:
            self._coarsen()
            return self.extend_to(points)
        (height, width), (left, top) = self.odds.shape, before
        odds = np.zeros((height + top + after[1], width + left + after[0]), np.float32)
        odds[top : top + height, left : left + width] = self.odds
        self.odds, self.first = odds, self.first - before
        self._measure()

    def _coarsen(self) -> None:
        """Cells twice as large, each as sure as its surest quarter."""
        start = self.first % 2
        end = (start + self.odds.shape[::-1]) % 2
        odds = np.pad(self.odds, list(zip(start[::-1], end[::-1], strict=True)))
        height, width = odds.shape
        self.odds = odds.reshape(height // 2, 2, width // 2, 2).max(axis=(1, 3))
        self.first, self.side = self.first // 2, 2 * self.side
        self._measure()


def in_sight(
    grids: Sequence[PlaneGrid], planes: PlaneSet, image: RangeImage
) -> dict[int, PlaneGrid]:
    """Numbers of planes, in the frame of the image, and the cells that a camera may look at.

    They are around what the pyramid of its rays, up to the farthest range measured, has of planes.
    """
    camera, corners = image.camera, np.zeros((5, 3))
    assert camera is not None
    nearest = cv2.minMaxLoc(image.inverse, (image.inverse > 0).view(np.uint8))[0]
    sides = [(u, v, 1.0) for u in (-0.5, camera.width - 0.5) for v in (-0.5, camera.height - 0.5)]
    farthest = np.linalg.inv(camera.matrix).T @ camera.axes.T / (nearest or np.inf)
    corners[1:] = np.array(sides) @ farthest
    height = corners @ planes.normal.T + planes.distance
    crossed = np.flatnonzero((height.min(axis=0) <= 0) & (height.max(axis=0) >= 0))
    some = planes.where(crossed)
    at = (corners - some.point[:, None]) @ np.swapaxes(some.axes, 1, 2)
    known = [grids[k] for k in crossed.tolist()]
    first = np.concatenate([np.zeros(0, np.intp), *(grid.first for grid in known)]).reshape(-1, 2)
    size = np.array([grid.odds.shape for grid in known]).reshape(-1, 2)[:, ::-1]
    side = np.array([grid.side for grid in known])[:, None]
    ends = np.floor(at.min(axis=1) / side), np.floor(at.max(axis=1) / side) + 1
    start, end = (np.clip(cell - first, 0, size).astype(np.intp) for cell in ends)
    inside = np.flatnonzero((start < end).all(axis=1)).tolist()
    return {int(crossed[n]): known[n].part(start[n], end[n]) for n in inside}


def seen_cells(
    grid: PlaneGrid, own: PlaneSet, plane: Plane, labels: Labels, camera: Camera
) -> Mask:
    """Cells (V, U) of a plane of the map, one in the frame of the image, where a frame found it.

    The plane that the frame found lies over the cells, which pixels of its label look at. Cells
    behind the camera get pixels beyond the horizon, which are never of the plane.
    """
    # From column, row and 1 to coordinates, points, points on the plane, and pixels.
    u, v = grid.side * (grid.first + 0.5)
    points = own.axes[0].T @ np.array([[grid.side, 0, u], [0, grid.side, v]])
    points[:, 2] += own.point[0]
    points -= np.outer(plane.normal, plane.normal @ points + [0, 0, plane.distance])
    pixels, size = camera.matrix @ camera.axes.T @ points, grid.odds.shape[::-1]
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(labels, pixels, size, flags=flags) == plane.label)


def passed_through(
    points: Floats,
    offset: Floats,
    variance: Callable[[Indices], Floats],
    image: RangeImage,
    sensor: SensorModel,
) -> Mask:
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
