"""The ground around the robot as an occupancy grid, and as points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.ground.classes import GROUND, UNKNOWN
from rangeseg_ros.core.ground.grid import GroundGrid
from rangeseg_ros.core.rotations import rotation_matrix
from rangeseg_ros.messages.make import GRID, Make, header_of, pose_of

_LETHAL = 100


def grid_message(make: Make, header: Any, grid: GroundGrid) -> Any:
    """nav_msgs/OccupancyGrid: 0 ground, 100 obstacle or drop, -1 unknown.

    `header` is that of the image: its frame is used where the grid has no fixed one.
    """
    values = np.where(grid.classes == GROUND, 0, _LETHAL).astype(np.int8)
    values[grid.classes == UNKNOWN] = -1
    info = make(
        'nav_msgs/msg/MapMetaData',
        map_load_time=make('builtin_interfaces/msg/Time', sec=0, nanosec=0),
        resolution=float(grid.resolution),
        width=values.shape[1],
        height=values.shape[0],
        origin=pose_of(make, grid.origin, grid.orientation),
    )
    return make(GRID, header=grid_header(make, header, grid), info=info, data=values.ravel())


def grid_header(make: Make, header: Any, grid: GroundGrid) -> Any:
    """Header of the messages of a grid: in the fixed frame where it has one."""
    return header_of(make, header.stamp, grid.frame) if grid.frame else header


def grid_points(grid: GroundGrid) -> NDArray[np.float32]:
    """Cells (N, 6) of a grid that are known: x, y, z, variance of the height, class, age.

    z is the height of the ground, or that of the ground below the camera where none was seen.
    """
    rows, columns = np.nonzero(grid.classes != UNKNOWN)
    place = (np.column_stack([columns, rows]) + 0.5) * grid.resolution
    place = np.column_stack([place, np.zeros(len(rows))]) @ rotation_matrix(grid.orientation).T
    place += grid.origin
    height = grid.height[rows, columns]
    if grid.frame:
        place[:, 2] = np.where(np.isnan(height), place[:, 2], height)
    others = (values[rows, columns] for values in (grid.variance, grid.classes, grid.age))
    return np.column_stack([place, *others]).astype(np.float32)
