"""Square blocks of pixels: what surfaces are grown from, and what tells the noise."""

from __future__ import annotations

from typing import NamedTuple

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


class Nodes(NamedTuple):
    """The blocks that surfaces are grown from.

    Attributes
    ----------
    moments : (rows, columns, 13) float64
        With weights according to the sensor, and the ratios of its variances. Zeros for blocks to
        leave out: that a jump crosses or that lack measurements in over 30 %, bridged holes being
        measured, or in over 75 % without these.
    residual : (rows, columns) float64
        What the plane through each leaves, with these weights.
    right, below : (rows, columns-1), (rows-1, columns) bool
        Whether a block touches its right, its lower neighbour: along half of their border at
        least.
    """

    moments: NDArray[np.float64]
    residual: NDArray[np.float64]
    right: NDArray[np.bool_]
    below: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        inverse: NDArray[np.float32],
        grid: Grid,
        blocks: Blocks,
        sensor: SensorModel,
        size: int,
    ) -> Nodes:
        """Those of an image.

        Parameters
        ----------
        inverse : (H, W) float32
            Holes bridged; 0 where nothing was measured.
        grid : Grid
            0 across jumps.
        blocks : Blocks
            Of the image.
        sensor : SensorModel
        size : int
            Rows and columns of a block.
        """
        rows, columns = blocks.squared.shape
        right = np.empty((rows, columns - 1), np.bool_)
        below = np.empty((rows - 1, columns), np.bool_)
        moments = np.empty_like(blocks.moments)
        nodes = cls(moments, np.empty((rows, columns)), right, below)
        run_rows(_fill_in, rows, inverse, grid, blocks, sensor, size, nodes)
        return nodes


def block_size(shape: tuple[int, int]) -> int:
    """Rows and columns of the blocks: 2 pixels below an eighth of VGA, 3 below half of it, 8 above
    twice VGA, and 4 between.

    Blocks of 4 pixels find faces 10 pixels wide; a larger image shows the same face larger, a
    smaller one smaller.
    """
    if shape[0] * shape[1] < VGA / 8:
        return 2
    if shape[0] * shape[1] < VGA / 2:
        return 3
    return 4 if shape[0] * shape[1] <= 2 * VGA else 8


@njit(cache=True, nogil=True)
def _fill_in(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    grid: Grid,
    blocks: Blocks,
    sensor: SensorModel,
    size: int,
    nodes: Nodes,
) -> None:
    """Fill in some rows of nodes."""
    whole = np.zeros(blocks.squared.shape, np.bool_)
    _find_whole(first, after, inverse, grid, size, whole)
    _weigh(first, after, blocks, whole, sensor, max(size * size // 4, 3), nodes)
    _link(first, after, grid, size, nodes)


@njit(cache=True, nogil=True)
def _find_whole(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    grid: Grid,
    size: int,
    result: NDArray[np.bool_],
) -> None:
    """Which of some rows of blocks no jump crosses and were measured, bridged holes included."""
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


@njit(cache=True, nogil=True)
def _link(
    first: int,
    after: int,
    grid: Grid,
    size: int,
    nodes: Nodes,
) -> None:
    """Link some rows of blocks to their neighbours."""
    right, below = nodes.right, nodes.below
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


@njit(cache=True, nogil=True)
def _weigh(
    first: int,
    after: int,
    blocks: Blocks,
    whole: NDArray[np.bool_],
    sensor: SensorModel,
    least: int,
    nodes: Nodes,
) -> None:
    """Weigh the whole ones of some rows of blocks, of at least so many measurements."""
    for i in range(first, after):
        for j in range(whole.shape[1]):
            count, squared = blocks.moments[i, j, COUNT], blocks.squared[i, j]
            if not whole[i, j] or count < least:
                nodes.moments[i, j] = 0
                nodes.residual[i, j] = 0
                continue
            level = random_variance(sensor, squared)
            tilt = tilt_variance(sensor, blocks.across[i, j], blocks.down[i, j]) / level
            weight = 1 / (level * (1 + tilt))
            for entry in range(COUNT):
                nodes.moments[i, j, entry] = weight * blocks.moments[i, j, entry]
            nodes.residual[i, j] = weight * blocks.residual[i, j]
            nodes.moments[i, j, COUNT] = count
            systematic = systematic_variance(sensor, squared)
            nodes.moments[i, j, RATIO] = count * weight * systematic
            nodes.moments[i, j, SLOPE] = count * tilt
