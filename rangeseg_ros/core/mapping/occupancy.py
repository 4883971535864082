"""Where something stands and where the ground was seen, in cells on the ground."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.plane_grid import HIT, LEAST, MISS
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of cells, as in nav_msgs/OccupancyGrid."""

# So many rows or columns of an image count, whichever are fewer.
_SAMPLES = 120


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


def points_within(image: RangeImage, sensor: SensorModel, error: float) -> NDArray[np.float64]:
    """Some points (N, 3) of an image that err by less than `error` along the ray, metres."""
    step = max(min(image.shape) // _SAMPLES, 1)
    sample = np.s_[::step, ::step]
    inverse = image.inverse[sample].astype(np.float64)
    squared = np.where(inverse > 0, inverse, 1) ** 2
    variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
    sure = (inverse > 0) & (variance < (error * squared) ** 2)
    return image.points[sample][sure].astype(np.float64)


def occupancy(
    points: Iterable[NDArray[np.float64]],
    ground: float,
    band: tuple[float, float],
    resolution: float,
) -> Grid:
    """Cells in which points stand in the way, or lie on the ground.

    Parameters
    ----------
    points : iterable of (N, 3) float64
        Of each frame, z up, metres.
    ground : float
        Height of the ground, metres.
    band : (float, float)
        Heights above the ground from which to which things are in the way, metres; what is as far
        below the ground as the band begins above it is no ground.
    resolution : float
        Side of a cell, metres.
    """
    # Points in the way, and on the ground.
    counts, first = np.zeros((2, 1, 1)), np.zeros(2, np.intp)
    for some in points:
        above = some[:, 2] - ground
        blocking = (above >= band[0]) & (above < band[1])
        used = blocking | (np.abs(above) < band[0])
        if not used.any():
            continue
        cells = np.floor(some[used, :2] / resolution).astype(np.intp)
        if not counts.any():
            first = cells[0]
        last = first + counts.shape[:0:-1]
        before = np.maximum(first - cells.min(axis=0), 0)
        after = np.maximum(cells.max(axis=0) + 1 - last, 0)
        if before.any() or after.any():
            counts = np.pad(counts, [(0, 0), *zip(before[::-1], after[::-1], strict=True)])
            first = first - before
        column, row = (cells - first).T
        np.add.at(counts, (np.where(blocking[used], 0, 1), row, column), 1)
    # The odds of a cell; a few points that err are no obstacle.
    values = np.where(counts[1] > 0, FREE, UNKNOWN)
    values[HIT * counts[0] + MISS * counts[1] > -LEAST] = OCCUPIED
    origin = (float(first[0] * resolution), float(first[1] * resolution))
    return Grid(values.astype(np.int8), origin, resolution)
