"""How far the surfaces beside the ground lie above it, or below."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.significance import SAMPLES


def around(where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Cells within three columns, or twelve rows, of one that is set."""
    result = cv2.dilate(where.view(np.uint8), np.ones((25, 7), np.uint8))
    return result.astype(np.uint8, copy=False)


class Sides(NamedTuple):
    """How surfaces lie beside the ground, (count + 1,), first what is none.

    Attributes
    ----------
    sizes : (...) int64
        Cells of the surface.
    height, noise : (...) float64
        Medians of the height of the cells beside the ground, or of all, and of what a pixel of
        them may err by, metres; NaN for surfaces that are too small.
    width : (...) int64
        Columns that these cells are in.
    beyond : (...) bool
        Whether it is beyond an edge that the ground falls from.
    """

    sizes: NDArray[np.int64]
    height: NDArray[np.float64]
    noise: NDArray[np.float64]
    width: NDArray[np.int64]
    beyond: NDArray[np.bool_]


def sides_of(
    height: NDArray[np.float32],
    unsure: NDArray[np.float32],
    surface: NDArray[np.int32],
    count: int,
    near: NDArray[np.uint8],
    fallen: NDArray[np.bool_],
) -> Sides:
    """Of the surfaces 1...count of cells (rows, columns), where `near` is beside the ground."""
    return Sides(*_sides_of(height, unsure, surface, count, near, fallen))


@njit(cache=True, nogil=True)
def _sides_of(
    height: NDArray[np.float32],
    unsure: NDArray[np.float32],
    surface: NDArray[np.int32],
    count: int,
    near: NDArray[np.uint8],
    fallen: NDArray[np.bool_],
) -> tuple[
    NDArray[np.int64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.int64],
    NDArray[np.bool_],
]:
    """Fields of the `Sides`."""
    rows, columns = surface.shape
    sizes = np.zeros(count + 1, np.int64)
    beside = np.zeros(count + 1, np.int64)
    beyond = np.zeros(count + 1, np.bool_)
    for i in range(rows):
        for c in range(columns):
            sizes[surface[i, c]] += 1
            beside[surface[i, c]] += near[i, c]
            beyond[surface[i, c]] |= fallen[i, c]
    sizes[0] = 0
    # Cells in the order of their surfaces.
    start = np.zeros(count + 2, np.int64)
    for k in range(count + 1):
        start[k + 1] = start[k] + (sizes[k] if sizes[k] >= SAMPLES else 0)
    heights = np.empty(start[-1], np.float32)
    noises = np.empty(start[-1], np.float32)
    filled = np.zeros(count + 1, np.int64)
    width = np.zeros(count + 1, np.int64)
    last = np.full(count + 1, -1)
    for c in range(columns):
        for i in range(rows):
            k = surface[i, c]
            if sizes[k] >= SAMPLES and (near[i, c] or beside[k] < SAMPLES):
                heights[start[k] + filled[k]] = height[i, c]
                noises[start[k] + filled[k]] = unsure[i, c]
                filled[k] += 1
                width[k] += last[k] != c
                last[k] = c
    side = np.full(count + 1, np.nan)
    noise = np.full(count + 1, np.nan)
    for k in range(count + 1):
        if filled[k]:
            side[k] = np.median(heights[start[k] : start[k] + filled[k]])
            noise[k] = np.median(noises[start[k] : start[k] + filled[k]])
    return sizes, side, noise, width, beyond
