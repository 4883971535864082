"""Height and class of every pixel, by the ground continued and what is known of its cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import CellSize
from rangeseg_ros.core.meaning.classes import DROP, GROUND, HIDDEN, OBSTACLE, UNKNOWN
from rangeseg_ros.core.meaning.ground_field import GroundField, planes_of_row, spread_planes
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import first_rays, next_rays

BLUR = (5, 3)
"""Cells that the edge of a drop is blurred over: two rows on either side, as many as a Kinect's
noise is correlated over, and the next column."""


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
    kind: NDArray[np.int8],
    fallen: NDArray[np.bool_],
    foot: NDArray[np.bool_],
    height: NDArray[np.float32],
    unsure: NDArray[np.float32],
    most: float,
) -> NDArray[np.float32]:
    """Complete what the surfaces of cells are said to be, and how far that may be doubted.

    Parameters
    ----------
    kind : (rows, columns) int8
        Changed: what is unknown beyond an edge is hidden, feet of obstacles are obstacles.
    fallen, foot : (rows, columns) bool
        Beyond an edge that the ground falls from, and feet.
    height, unsure : (rows, columns) float32
        Above the ground, and its noise, metres.
    most : float
        No noise excuses more, metres.

    Returns
    -------
    (rows, columns) float32
        `doubt` of `Said`.
    """
    rows, columns = kind.shape
    doubt = np.empty(kind.shape, np.float32)
    bound = np.float32(most)
    high, wide = BLUR[0] // 2, BLUR[1] // 2
    for i in range(rows):
        for c in range(columns):
            if foot[i, c]:
                kind[i, c] = OBSTACLE
            elif fallen[i, c] and kind[i, c] == UNKNOWN:
                kind[i, c] = HIDDEN
            doubt[i, c] = min(unsure[i, c], bound)
    # Beside a drop, or what may be one, the sensor blurs its edge: no noise excuses what is low.
    for i in range(rows):
        for c in range(columns):
            if kind[i, c] == DROP or (kind[i, c] == HIDDEN and height[i, c] < 0):
                for k in range(max(i - high, 0), min(i + high + 1, rows)):
                    for m in range(max(c - wide, 0), min(c + wide + 1, columns)):
                        doubt[k, m] = 0
    return doubt


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
    groups = np.empty((4, said.kind.shape[1] * size.rows), np.float32)
    limits = np.empty((4, said.kind.shape[1] * size.columns), np.float32)
    planes = np.empty((4, width), np.float32)
    ray = first_rays(rays, first * size.rows)
    for i in range(first, after):
        planes_of_row(spread, ((i + 0.5) * size.rows) / field.rows - 0.5, planes)
        _bound(said, i, size.rows, bounds, groups)
        _widen(groups, limits)
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
def _bound(
    said: Said, i: int, number: int, bounds: tuple[float, float], limits: NDArray[np.float32]
) -> None:
    """Limits of row i of cells, each as often as it has groups of four pixels."""
    for c in range(said.kind.shape[1]):
        kind, doubt, unsure = said.kind[i, c], said.doubt[i, c], said.unsure[i, c]
        low, high = np.float32(-bounds[1]), np.float32(bounds[0])
        if kind == GROUND:
            low, high = min(low, -doubt), max(high, doubt)
        drop, obstacle = min(low, -unsure), max(high, unsure)
        if kind == HIDDEN:
            low, high = np.float32(np.inf), np.float32(-np.inf)
        elif kind > GROUND:
            low, high = np.float32(np.inf), np.float32(-np.inf)
            drop = high if kind == OBSTACLE else low
            obstacle = drop
        for j in range(c * number, (c + 1) * number):
            limits[0, j], limits[1, j], limits[2, j], limits[3, j] = drop, low, high, obstacle


@njit(cache=True, inline='always')
def _widen(groups: NDArray[np.float32], limits: NDArray[np.float32]) -> None:
    """Limits of pixels from those of groups of four, as cells are multiples of four wide.

    Written out and with indices that have no sign, the four are one vector instruction.
    """
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    for n in range(len(groups)):
        for g in range(np.uint64(groups.shape[1])):
            value, j = groups[n, g], four * g
            limits[n, j] = value
            limits[n, j + one] = value
            limits[n, j + two] = value
            limits[n, j + three] = value
