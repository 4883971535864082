"""Square blocks of pixels: what surfaces are grown from, and what tells the noise."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.moments import COUNT, RATIO, SLOPE
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    random_variance,
    systematic_variance,
    tilt_variance,
)

# Share of a block that must have been measured.
_MEASURED = 0.7

# (rows, columns-1) and (rows-1, columns): whether a block touches its right, its lower neighbour.
Links = tuple[NDArray[np.bool_], NDArray[np.bool_]]


def block_size(shape: tuple[int, int]) -> int:
    """Rows and columns of the blocks: 3 pixels below half of VGA, 4 up to twice VGA, 8 above.

    Blocks of 4 pixels find faces 10 pixels wide; a larger image shows the same face larger, a
    smaller one smaller.
    """
    if shape[0] * shape[1] < VGA / 2:
        return 3
    return 4 if shape[0] * shape[1] <= 2 * VGA else 8


def whole_blocks(inverse: NDArray[np.float32], grid: Grid, size: int) -> NDArray[np.bool_]:
    """Blocks that no jump crosses and that were measured.

    Parameters
    ----------
    inverse : (H, W) float32
        0 where nothing was measured.
    grid : Grid
        0 across jumps.
    size : int
        Rows and columns of a block.

    Returns
    -------
    (ceil(H / size), ceil(W / size)) bool
        False for blocks that a jump edge crosses or that lack measurements in over 30 %.
    """
    height, width = inverse.shape
    result = np.zeros((-(-height // size), -(-width // size)), np.bool_)
    run_rows(_find_whole, len(result), inverse, grid, size, result)
    return result


@njit(cache=True, nogil=True)
def _find_whole(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    grid: Grid,
    size: int,
    result: NDArray[np.bool_],
) -> None:
    """The same of some rows of blocks, from what the columns of a row of blocks hold."""
    height, width = inverse.shape
    measured, across = np.empty(width, np.uint8), np.empty(width, np.bool_)
    down = np.empty(width, np.bool_)
    for bi in range(first, after):
        bottom = min((bi + 1) * size, height)
        measured[:], across[:], down[:] = 0, False, False
        for i in range(bi * size, bottom):
            for j in range(width):
                measured[j] += inverse[i, j] > 0
            for j in range(width - 1):
                both = (inverse[i, j] > 0) & (inverse[i, j + 1] > 0)
                across[j] |= both & (grid.right[i, j] == 0)
            if i + 1 < bottom:
                for j in range(width):
                    both = (inverse[i, j] > 0) & (inverse[i + 1, j] > 0)
                    down[j] |= both & (grid.below[i, j] == 0)
        for bj in range(result.shape[1]):
            right = min((bj + 1) * size, width)
            crossed, count = False, 0
            for j in range(bj * size, right):
                count += measured[j]
                crossed |= down[j] | (across[j] & (j + 1 < right))
            result[bi, bj] = not crossed and count >= _MEASURED * size * size


def block_links(grid: Grid, size: int) -> Links:
    """Whether a block touches its right, its lower neighbour: along half of their border at least.

    Parameters
    ----------
    grid : Grid
    size : int
        Rows and columns of a block.

    Returns
    -------
    right, below : (rows, columns-1), (rows-1, columns) bool
    """
    height, width = len(grid.right), grid.below.shape[1]
    rows, columns = -(-height // size), -(-width // size)
    right, below = np.zeros((rows, columns - 1), np.bool_), np.zeros((rows - 1, columns), np.bool_)
    run_rows(_link, rows, grid, size, right, below)
    return right, below


@njit(cache=True, nogil=True)
def _link(
    first: int,
    after: int,
    grid: Grid,
    size: int,
    right: NDArray[np.bool_],
    below: NDArray[np.bool_],
) -> None:
    """The same of some rows of blocks."""
    height, width = len(grid.right), grid.below.shape[1]
    for bi in range(first, after):
        for bj in range(right.shape[1]):
            touching = 0
            for i in range(bi * size, min((bi + 1) * size, height)):
                touching += grid.right[i, (bj + 1) * size - 1] > 0
            right[bi, bj] = 2 * touching >= size
    for bi in range(first, min(after, len(below))):
        for bj in range(below.shape[1]):
            touching = 0
            for j in range(bj * size, min((bj + 1) * size, width)):
                touching += grid.below[(bi + 1) * size - 1, j] > 0
            below[bi, bj] = 2 * touching >= size


def weigh_blocks(
    blocks: Blocks, whole: NDArray[np.bool_], sensor: SensorModel
) -> NDArray[np.float64]:
    """Moments with weights according to the sensor, and the ratios of its variances.

    Parameters
    ----------
    blocks : Blocks
        (rows, columns).
    whole : (rows, columns) bool
        Blocks to weigh; the others become zeros.
    sensor : SensorModel
    """
    result = np.zeros_like(blocks.moments)
    run_rows(_weigh, len(result), blocks, whole, sensor, result)
    return result


@njit(cache=True, nogil=True)
def _weigh(
    first: int,
    after: int,
    blocks: Blocks,
    whole: NDArray[np.bool_],
    sensor: SensorModel,
    result: NDArray[np.float64],
) -> None:
    """The same of some rows of blocks."""
    for i in range(first, after):
        for j in range(result.shape[1]):
            if not whole[i, j]:
                continue
            count, squared = blocks.moments[i, j, COUNT], blocks.squared[i, j]
            level = random_variance(sensor, squared)
            tilt = tilt_variance(sensor, blocks.across[i, j], blocks.down[i, j]) / level
            weight = 1 / (level * (1 + tilt))
            for entry in range(COUNT):
                result[i, j, entry] = weight * blocks.moments[i, j, entry]
            result[i, j, COUNT] = count
            systematic = systematic_variance(sensor, squared)
            result[i, j, RATIO] = count * weight * systematic
            result[i, j, SLOPE] = count * tilt
