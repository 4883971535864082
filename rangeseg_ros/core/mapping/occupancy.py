"""Where something stands and where the ground was seen, in cells on the ground."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.plane_grid import HIT, MISS, PlaneGrid
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of cells, as in nav_msgs/OccupancyGrid."""

# So many rows or columns of an image count, whichever are fewer.
_SAMPLES = 120


class Grid(NamedTuple):
    """Cells (H, W) on the ground, `FREE`, `OCCUPIED` or `UNKNOWN`, row 0 at the least y.

    `origin` is the outer corner (x, y) of the first cell, metres, `resolution` their side.
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
) -> PlaneGrid:
    """Log-odds that something stands in the way in cells of the ground.

    Points (N, 3) of each frame are with z up, as the heights of the ground and of the band above
    it in which things are in the way, metres. What is as far below the ground as the band begins
    above it is no ground.
    """
    grid = PlaneGrid(resolution, np.inf)
    for some in points:
        above = some[:, 2] - ground
        for chosen, change in (
            ((above >= band[0]) & (above < band[1]), HIT),
            (np.abs(above) < band[0], MISS),
        ):
            if chosen.any():
                grid.reach(some[chosen, :2])
                np.add.at(grid.odds, grid.cells(some[chosen, :2]), change)
    return grid
