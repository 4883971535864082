"""Height and class of every pixel, by the ground continued and the limits of its cell."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.ground.cells import CellSize
from rangeseg_ros.core.ground.classes import DROP, GROUND, OBSTACLE
from rangeseg_ros.core.ground.field import GroundField, planes_of_row, spread_planes
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import first_rays, next_rays


def pixels_of(
    image: RangeImage, field: GroundField, size: CellSize, limits: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Class and height of every pixel.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    field : GroundField
    size : CellSize
    limits : (4, rows, columns) float32
        Of the cells, metres: a pixel that is lower than the first is a drop, between the second
        and the third ground, higher than the fourth an obstacle.

    Returns
    -------
    classes : (H, W) uint8
        0 where not measured.
    heights : (H, W) float32
        Along up above the ground, metres; NaN where not measured.
    """
    classes = np.empty(image.shape, np.uint8)
    heights = np.empty(image.shape, np.float32)
    run_rows(_classify, limits.shape[1], image.inverse, image.rays, image.pinhole, field, size,
             limits, classes, heights)  # fmt: skip
    return classes, heights


@njit(cache=True, nogil=True, error_model='numpy')
def _classify(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    field: GroundField,
    size: CellSize,
    limits_of_cells: NDArray[np.float32],
    classes: NDArray[np.uint8],
    heights: NDArray[np.float32],
) -> None:
    """Of rows first...after of cells.

    Ten parameters, as a kernel cannot return what several threads write. The inner loops do the
    same for every pixel, so that the compiler makes them vector instructions.
    """
    width = inverse.shape[1]
    spread = spread_planes(field, width, first * size.rows, after * size.rows)
    # Heights between which a pixel is ground, and beyond which it is a drop or an obstacle.
    groups = np.empty((4, limits_of_cells.shape[2] * size.rows), np.float32)
    limits = np.empty((4, limits_of_cells.shape[2] * size.columns), np.float32)
    planes = np.empty((4, width), np.float32)
    ray = first_rays(rays, first * size.rows)
    for i in range(first, after):
        planes_of_row(spread, ((i + 0.5) * size.rows) / field.rows - 0.5, planes)
        _widen(limits_of_cells[:, i], groups, limits)
        for v in range(i * size.rows, min((i + 1) * size.rows, len(inverse))):
            next_rays(rays, pinhole, v, ray)
            for j in range(width):
                value = inverse[v, j]
                along = planes[0, j] * ray[0, j] + planes[1, j] * ray[1, j]
                along += planes[2, j] * ray[2, j]
                height = (along - value) / (value * planes[3, j])
                heights[v, j] = height if value > 0 else np.float32(np.nan)
            for j in range(width):
                height = heights[v, j]
                # All of them are false where nothing was measured.
                classes[v, j] = (
                    np.uint8((height >= limits[1, j]) & (height <= limits[2, j])) * GROUND
                    + np.uint8(height > limits[3, j]) * OBSTACLE
                    + np.uint8(height < limits[0, j]) * DROP
                )


@njit(cache=True, inline='always')
def _widen(
    cells: NDArray[np.float32], groups: NDArray[np.float32], limits: NDArray[np.float32]
) -> None:
    """Limits of pixels from those of cells, by those of groups of four, as many as fit a cell.

    Written out and with indices that have no sign, the four are one vector instruction.
    """
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    number = np.uint64(groups.shape[1] // cells.shape[1])
    for n in range(len(cells)):
        for c in range(np.uint64(cells.shape[1])):
            for k in range(number):
                groups[n, c * number + k] = cells[n, c]
        for g in range(np.uint64(groups.shape[1])):
            value, j = groups[n, g], four * g
            limits[n, j] = value
            limits[n, j + one] = value
            limits[n, j + two] = value
            limits[n, j + three] = value
