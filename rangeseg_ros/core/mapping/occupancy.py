"""Where something stands and where the ground was seen, in cells on the ground.

The points of all frames are counted in voxels of the fixed frame, so that the direction of up and
the height of the ground need be known at the end only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.evidence import HIT, LEAST, MISS
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of cells, as in nav_msgs/OccupancyGrid."""

# So many rows or columns of an image count, whichever are fewer; voxels are united after so many
# points.
_SAMPLES, _PENDING = 120, 2**20
_BITS = 21


class Grid(NamedTuple):
    """Cells on the ground.

    Attributes
    ----------
    cells : (H, W) int8
        `FREE`, `OCCUPIED` or `UNKNOWN`; row 0 at the least y.
    origin : (float, float)
        x and y of the outer corner of the first cell, metres.
    resolution : float
        Side of a cell, metres.
    """

    cells: NDArray[np.int8]
    origin: tuple[float, float]
    resolution: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.int8]:
        """Values (N,) at points (N, 2)."""
        column, row = np.floor((points - self.origin) / self.resolution).astype(np.intp).T
        height, width = self.cells.shape
        inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
        values = np.full(len(points), UNKNOWN, np.int8)
        values[inside] = self.cells[row[inside], column[inside]]
        return values


class VoxelCounts:
    """Numbers of points in cubes of the fixed frame.

    Parameters
    ----------
    resolution : float
        Side of the cells that they are for, metres. Cubes are half as large, so that in a frame
        that is turned no cell between others stays empty.
    sensor : SensorModel
        Points whose standard deviation along the ray is larger than a cell do not count.
    """

    def __init__(self, resolution: float, sensor: SensorModel) -> None:
        self.side = resolution / 2
        self._sensor = sensor
        self._keys = self._counts = np.zeros(0, np.int64)
        self._pending: list[NDArray[np.int64]] = []

    def add(self, image: RangeImage, pose: Transform) -> None:
        """Count the points of an image taken at `pose`."""
        step = max(min(image.shape) // _SAMPLES, 1)
        sample = np.s_[::step, ::step]
        inverse = image.inverse[sample].astype(np.float64)
        squared = np.where(inverse > 0, inverse, 1) ** 2
        variance = random_variance(self._sensor, squared)
        variance += systematic_variance(self._sensor, squared)
        sure = (inverse > 0) & (variance < (2 * self.side * squared) ** 2)
        points = image.points[sample][sure].astype(np.float64) @ pose.rotation.T + pose.shift
        cubes = np.floor(points / self.side).astype(np.int64) + 2 ** (_BITS - 1)
        cubes = cubes[((cubes >= 0) & (cubes < 2**_BITS)).all(axis=1)]
        self._pending.append((cubes[:, 0] << 2 * _BITS) | (cubes[:, 1] << _BITS) | cubes[:, 2])
        if sum(map(len, self._pending)) > _PENDING:
            self._unite()

    def points(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Centres (N, 3) of the cubes that are not empty, and numbers (N,) of their points."""
        self._unite()
        mask = 2**_BITS - 1
        parts = self._keys >> 2 * _BITS, (self._keys >> _BITS) & mask, self._keys & mask
        cubes = np.stack(parts, axis=1) - 2 ** (_BITS - 1)
        return (cubes + 0.5) * self.side, self._counts

    def _unite(self) -> None:
        keys = np.concatenate([self._keys, *self._pending])
        weights = np.ones(len(keys), np.int64)
        weights[: len(self._counts)] = self._counts
        self._keys, place = np.unique(keys, return_inverse=True)
        self._counts = np.bincount(place, weights, len(self._keys)).astype(np.int64)
        self._pending = []


def occupancy(
    points: NDArray[np.float64],
    counts: NDArray[np.int64],
    ground: float,
    band: tuple[float, float],
    resolution: float,
) -> Grid:
    """Cells in which points stand in the way, or lie on the ground.

    Parameters
    ----------
    points : (N, 3) float64
        z up, metres.
    counts : (N,) int64
        Of measured points that each stands for.
    ground : float
        Height of the ground, metres.
    band : (float, float)
        Heights above the ground from which to which things are in the way, metres; what is as far
        below the ground as the band begins above it is no ground.
    resolution : float
        Side of a cell, metres.
    """
    above = points[:, 2] - ground
    relevant = np.abs(above) < band[0]
    blocking = (above >= band[0]) & (above < band[1])
    used = relevant | blocking
    if not used.any():
        return Grid(np.full((1, 1), UNKNOWN, np.int8), (0.0, 0.0), resolution)
    cells = np.floor(points[used, :2] / resolution).astype(np.intp)
    first = cells.min(axis=0)
    width, height = cells.max(axis=0) - first + 1
    number = (cells[:, 1] - first[1]) * width + cells[:, 0] - first[0]
    hits, misses = (
        np.bincount(number, counts[used] * chosen[used], height * width)
        for chosen in (blocking, relevant)
    )
    # The odds of a cell; a few points that err are no obstacle.
    odds = HIT * hits + MISS * misses
    values = np.where(misses > 0, FREE, UNKNOWN)
    values[odds > -LEAST] = OCCUPIED
    origin = (float(first[0] * resolution), float(first[1] * resolution))
    return Grid(values.reshape(height, width).astype(np.int8), origin, resolution)
