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
    low, high : (...) float32
        Heights that a pixel of the ground is between, metres.
    unsure : (...) float32
        The noise of a pixel's height: where it is not higher, nothing is claimed to be an
        obstacle, where it is not deeper, nothing to be a drop. Metres.
    """

    kind: NDArray[np.int8]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    unsure: NDArray[np.float32]


def decide(
    verdict: NDArray[np.int8],
    surface: NDArray[np.int32],
    ground: NDArray[np.bool_],
    fallen: NDArray[np.bool_],
    foot: NDArray[np.bool_],
    height: NDArray[np.float32],
    unsure: NDArray[np.float32],
    least: tuple[float, float],
    most: float,
    alike: tuple[int, int],
) -> Said:
    """What is said of cells, by their surfaces and by themselves.

    More than seven parameters: those of a kernel, which takes arrays.

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
    least : (float, float)
        The least obstacle, and the least drop, metres: what is not half so high, or so deep, is
        more probably ground.
    most : float
        No noise excuses more, metres.
    alike : (int, int)
        Rows and columns that err alike.
    """
    found = _decide(verdict, surface, ground, fallen, foot, height, unsure, least, most, alike)
    return Said(*found, unsure)


@njit(cache=True, nogil=True)
def _decide(
    verdict: NDArray[np.int8],
    surface: NDArray[np.int32],
    ground: NDArray[np.bool_],
    fallen: NDArray[np.bool_],
    foot: NDArray[np.bool_],
    height: NDArray[np.float32],
    unsure: NDArray[np.float32],
    least: tuple[float, float],
    most: float,
    alike: tuple[int, int],
) -> tuple[NDArray[np.int8], NDArray[np.float32], NDArray[np.float32]]:
    """Kind, low and high of `Said`."""
    rows, columns = surface.shape
    kind = np.empty((rows, columns), np.int8)
    low, top = np.empty((2, rows, columns), np.float32)
    tall, deep = np.float32(least[0] / 2), np.float32(-least[1] / 2)
    for i in range(rows):
        for c in range(columns):
            own = np.int8(GROUND) if ground[i, c] else verdict[surface[i, c]]
            if fallen[i, c] and own == UNKNOWN:
                own = np.int8(HIDDEN)
            kind[i, c] = np.int8(OBSTACLE) if foot[i, c] else own
            excused = min(unsure[i, c], np.float32(most)) if own == GROUND else np.float32(0)
            low[i, c], top[i, c] = min(deep, -excused), max(tall, excused)
    found, blurred = np.empty((2, rows, columns), np.uint8)
    for i in range(rows):
        for c in range(columns):
            found[i, c] = (kind[i, c] == DROP) | ((kind[i, c] == HIDDEN) & fallen[i, c])
            blurred[i, c] = found[i, c] | ((kind[i, c] == HIDDEN) & (height[i, c] < 0))
    high, wide = BLUR[0] // 2, BLUR[1] // 2
    # Beside a drop, or what may be one, the sensor blurs its edge: no noise excuses what is low.
    beside = _around(blurred, high, wide)
    for i in range(rows):
        for c in range(columns):
            low[i, c] = deep if beside[i, c] > 0 else low[i, c]
            top[i, c] = tall if beside[i, c] > 0 else top[i, c]
    # Noise that lifts a part of a drop is as wide as what errs alike: so far from what is found of
    # it, ground is what could not as well be the least drop, as a whole cell.
    doubtful = _around(found, max(high, alike[0]), max(wide, alike[1]))
    for i in range(rows):
        for c in range(columns):
            told = unsure[i, c] - np.float32(least[1])
            bound = told if height[i, c] > told else np.float32(np.inf)
            low[i, c] = bound if (doubtful[i, c] > 0) & (told > deep) else low[i, c]
    return kind, low, top


@njit(cache=True, nogil=True)
def _around(where: NDArray[np.uint8], high: int, wide: int) -> NDArray[np.uint8]:
    """Cells within so many rows and columns of one that is set.

    Short loops without a branch, which the compiler makes vector instructions.
    """
    rows, columns = where.shape
    result = np.zeros((rows, columns), np.uint8)
    column = np.zeros(columns + 2 * wide, np.uint8)
    last = -1  # the last row near to which there is one
    for i in range(rows + high):
        if i < rows:
            some = np.uint8(0)
            for c in range(columns):
                some |= where[i, c]
            last = i + 2 * high if some else last
        if i < high or i > last:
            continue
        column[:] = 0
        for k in range(max(i - 2 * high, 0), min(i + 1, rows)):
            for c in range(columns):
                column[c + wide] |= where[k, c]
        for k in range(2 * wide + 1):
            for c in range(columns):
                result[i - high, c] |= column[c + k]
    return result


def pixels_of(
    image: RangeImage,
    field: GroundField,
    size: CellSize,
    said: Said,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Classes and heights of pixels.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    field : GroundField
    size : CellSize
    said : Said

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
             said, classes, heights)  # fmt: skip
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
    of_cells = np.empty((4, said.kind.shape[1]), np.float32)
    groups = np.empty((4, said.kind.shape[1] * size.rows), np.float32)
    limits = np.empty((4, said.kind.shape[1] * size.columns), np.float32)
    planes = np.empty((4, width), np.float32)
    ray = first_rays(rays, first * size.rows)
    for i in range(first, after):
        planes_of_row(spread, ((i + 0.5) * size.rows) / field.rows - 0.5, planes)
        _bound(said, i, of_cells)
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
def _bound(said: Said, i: int, limits: NDArray[np.float32]) -> None:
    """Limits of row i of cells, without a branch, as vector instructions."""
    endless = np.float32(np.inf)
    for c in range(limits.shape[1]):
        kind, unsure = said.kind[i, c], said.unsure[i, c]
        low, high = said.low[i, c], said.high[i, c]
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
