"""Height and class of every pixel, by the ground continued and what is known of its cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import CellSize
from rangeseg_ros.core.meaning.classes import DROP, GROUND, HIDDEN, OBSTACLE, UNKNOWN
from rangeseg_ros.core.meaning.ground_field import GroundField, planes_of_row, spread_planes
from rangeseg_ros.core.meaning.verdicts import BLUR
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import first_rays, next_rays


class Said(NamedTuple):
    """What is known of cells, (rows, columns).

    Attributes
    ----------
    kind : (...) int8
        Obstacle or drop as a whole, ground, or unknown.
    doubt : (...) float32
        Heights beyond it contradict that a pixel is ground, metres.
    unsure : (...) float32
        The noise of a pixel's height: where it is not higher, nothing is claimed to be an
        obstacle, where it is not deeper, nothing to be a drop. Metres.
    """

    kind: NDArray[np.int8]
    doubt: NDArray[np.float32]
    unsure: NDArray[np.float32]


@njit(cache=True, nogil=True)
def decide(
    verdict: NDArray[np.int8],
    surface: NDArray[np.int32],
    ground: NDArray[np.bool_],
    fallen: NDArray[np.bool_],
    foot: NDArray[np.bool_],
    height: NDArray[np.float32],
    unsure: NDArray[np.float32],
    most: float,
) -> Said:
    """What is said of cells, by their surfaces and by themselves.

    Eight parameters: a kernel that takes arrays.

    Parameters
    ----------
    verdict : (N,) int8
        What surfaces are.
    surface : (rows, columns) int32
        Of each cell.
    ground, fallen, foot : (rows, columns) bool
        Ground; beyond an edge that it falls from, where what is unknown is hidden; and feet of
        obstacles, which are obstacles.
    height, unsure : (rows, columns) float32
        Above the ground, and its noise, metres.
    most : float
        No noise excuses more, metres.
    """
    rows, columns = surface.shape
    kind = np.empty((rows, columns), np.int8)
    doubt = np.empty(kind.shape, np.float32)
    bound = np.float32(most)
    high, wide = BLUR[0] // 2, BLUR[1] // 2
    for i in range(rows):
        for c in range(columns):
            own = np.int8(GROUND) if ground[i, c] else verdict[surface[i, c]]
            if fallen[i, c] and own == UNKNOWN:
                own = np.int8(HIDDEN)
            kind[i, c] = np.int8(OBSTACLE) if foot[i, c] else own
            doubt[i, c] = min(unsure[i, c], bound)
    # Beside a drop, or what may be one, the sensor blurs its edge: no noise excuses what is low.
    low = np.zeros((rows + 2 * high, columns + 2 * wide), np.bool_)
    for i in range(rows):
        for c in range(columns):
            hidden = (kind[i, c] == HIDDEN) & (height[i, c] < 0)
            low[i + high, c + wide] = (kind[i, c] == DROP) | hidden
    beside = np.empty(low.shape[1], np.bool_)
    for i in range(rows):
        beside[:] = False
        for k in range(BLUR[0]):
            for c in range(len(beside)):
                beside[c] |= low[i + k, c]
        for k in range(BLUR[1]):
            for c in range(columns):
                doubt[i, c] = np.float32(0) if beside[c + k] else doubt[i, c]
    return Said(kind, doubt, unsure)


def pixels_of(
    image: RangeImage,
    field: GroundField,
    size: CellSize,
    said: Said,
    bounds: tuple[float, float],
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Classes and heights of pixels.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    field : GroundField
    size : CellSize
    said : Said
    bounds : (float, float)
        Half of the least obstacle, and of the least drop, metres: what is not so high, or so
        deep, is more probably ground.

    Returns
    -------
    classes : (H, W) uint8
        0 where not measured.
    heights : (H, W) float32
        Along up above the ground, metres; NaN where not measured.
    """
    classes = np.empty(image.shape, np.uint8)
    heights = np.empty(image.shape, np.float32)
    run_rows(_classify, len(said.kind), image.inverse, image.rays, image.pinhole, field, size,
             said, bounds, classes, heights)  # fmt: skip
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
    said: Said,
    bounds: tuple[float, float],
    classes: NDArray[np.uint8],
    heights: NDArray[np.float32],
) -> None:
    """Of rows first...after of cells.

    Eleven parameters, as a kernel cannot return what several threads write. The inner loops do the
    same for every pixel, so that the compiler makes them vector instructions.
    """
    width = inverse.shape[1]
    spread = spread_planes(field, width, first * size.rows, after * size.rows)
    # Heights between which a pixel is ground, and beyond which it is a drop or an obstacle.
    of_cells = np.empty((4, said.kind.shape[1]), np.float32)
    groups = np.empty((4, said.kind.shape[1] * size.rows), np.float32)
    limits = np.empty((4, said.kind.shape[1] * size.columns), np.float32)
    planes = np.empty((4, width), np.float32)
    ray = first_rays(rays, first * size.rows)
    for i in range(first, after):
        planes_of_row(spread, ((i + 0.5) * size.rows) / field.rows - 0.5, planes)
        _bound(said, i, bounds, of_cells)
        _widen(of_cells, groups, limits)
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
def _bound(said: Said, i: int, bounds: tuple[float, float], limits: NDArray[np.float32]) -> None:
    """Limits of row i of cells, without a branch, as vector instructions."""
    deep, tall, endless = np.float32(-bounds[1]), np.float32(bounds[0]), np.float32(np.inf)
    for c in range(limits.shape[1]):
        kind, doubt, unsure = said.kind[i, c], said.doubt[i, c], said.unsure[i, c]
        low = min(deep, -doubt) if kind == GROUND else deep
        high = max(tall, doubt) if kind == GROUND else tall
        drop, obstacle = min(low, -unsure), max(high, unsure)
        never = (kind == HIDDEN) | (kind > GROUND)
        whole = -endless if kind == OBSTACLE else endless
        limits[0, c] = whole if kind > GROUND else drop
        limits[1, c] = endless if never else low
        limits[2, c] = -endless if never else high
        limits[3, c] = whole if kind > GROUND else obstacle


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
