"""The ground around the robot as an occupancy grid, and as points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured

from rangeseg_ros.core.ground.cells import GROUND, UNKNOWN
from rangeseg_ros.core.ground.grid import GroundGrid
from rangeseg_ros.core.rotations import rotation_matrix
from rangeseg_ros.messages.clouds import POINT_TYPE, cloud_message
from rangeseg_ros.messages.make import GRID, Make, header_of, pose_of

_LETHAL = 100
# The grid of an image whose ground is not looked for.
_NONE = np.zeros((0, 0), np.float32)
_EMPTY = GroundGrid(
    _NONE.astype(np.uint8), _NONE, _NONE, _NONE, 0.0, np.zeros(3), np.eye(4)[3], ''
)
_CELL_TYPE = np.dtype(
    [*POINT_TYPE.descr, ('height_variance', '<f4'), ('class', '<u4'), ('age', '<f4')]
)


def grid_message(make: Make, header: Any, grid: GroundGrid | None) -> Any:
    """nav_msgs/OccupancyGrid: 0 ground, 100 obstacle or drop, -1 unknown.

    `header` is that of the image: its frame is used where the grid has no fixed one.
    """
    grid = grid or _EMPTY
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
    return make(GRID, header=_header(make, header, grid), info=info, data=values.ravel())


def grid_points_message(make: Make, header: Any, grid: GroundGrid | None) -> Any:
    """sensor_msgs/PointCloud2 of the cells that are known.

    z is the height of the ground, or that of the ground below the camera where none was seen.
    """
    grid = grid or _EMPTY
    rows, columns = np.nonzero(grid.classes != UNKNOWN)
    place = (np.column_stack([columns, rows]) + 0.5) * grid.resolution
    place = np.column_stack([place, np.zeros(len(rows))]) @ rotation_matrix(grid.orientation).T
    place += grid.origin
    height = grid.height[rows, columns]
    if grid.frame:
        place[:, 2] = np.where(np.isnan(height), place[:, 2], height)
    others = (values[rows, columns] for values in (grid.variance, grid.classes, grid.age))
    points = np.column_stack([place, *others])
    records = unstructured_to_structured(points, _CELL_TYPE, casting='unsafe')
    return cloud_message(make, _header(make, header, grid), records)


def _header(make: Make, header: Any, grid: GroundGrid) -> Any:
    """In the fixed frame where the grid has one."""
    return header_of(make, header.stamp, grid.frame) if grid.frame else header
