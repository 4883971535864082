"""Square blocks of pixels: what surfaces are grown from, and what tells the noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
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
    count = nodes.residual.shape[1]
    # Zeros beyond the image, and bytes, as the compiler takes many of these at a time.
    columns, whole = np.empty((6, count * size), np.uint8), np.empty(count, np.bool_)
    for bi in range(first, after):
        _look(bi * size, min((bi + 1) * size, len(inverse)), inverse, grid, columns)
        # Nearly always of a size that the compiler knows.
        if size == BLOCK:
            _link(bi, columns, BLOCK, whole, nodes)
        else:
            _link(bi, columns, size, whole, nodes)
        _weigh(bi, blocks, whole, sensor, max(size * size // 4, 3), nodes)


@njit(cache=True, nogil=True)
def _look(
    top: int,
    bottom: int,
    inverse: NDArray[np.float32],
    grid: Grid,
    columns: NDArray[np.uint8],
) -> None:
    """Look at the pixels of a row of blocks.

    `columns` (6, W or more) receives for every column how many were measured, how many are
    connected with the next one to the right and whether a jump parts one from it, and the same of
    those below as far as they are in these rows; last, whether the one in the last row is
    connected with that below.
    """
    columns[:] = 0
    for i in range(top, bottom):
        here = inverse[i]
        for j in range(len(here)):
            columns[0, j] += here[j] > 0
        _look_beside(here, here[1:], grid.right[i], columns[1], columns[2])
        if i + 1 < bottom:
            _look_beside(here, inverse[i + 1], grid.below[i], columns[3], columns[4])
    if bottom < len(inverse):
        below = grid.below[bottom - 1]
        for j in range(len(below)):
            columns[5, j] = below[j] > 0


@njit(cache=True, nogil=True)
def _look_beside(
    here: NDArray[np.float32],
    beside: NDArray[np.float32],
    weight: NDArray[np.float32],
    joined: NDArray[np.uint8],
    parted: NDArray[np.uint8],
) -> None:
    """Count edges of a row that connect pixels, and mark those that jumps cross."""
    for j in range(len(weight)):
        joined[j] += weight[j] > 0
        parted[j] |= (here[j] > 0) & (beside[j] > 0) & (weight[j] == 0)


@njit(cache=True, inline='always')
def _link(
    bi: int, columns: NDArray[np.uint8], size: int, whole: NDArray[np.bool_], nodes: Nodes
) -> None:
    """Link a row of blocks to their neighbours, and tell which are `whole`.

    Those that no jump crosses and that were measured, bridged holes included.
    """
    measured, joined, across, down = columns[0], columns[1], columns[2], columns[4]
    least = np.ceil(_MEASURED * size * size)
    for bj in range(len(whole)):
        count, crossed = 0, 0
        for k in range(size):
            count += measured[bj * size + k]
            crossed |= down[bj * size + k]
        for k in range(size - 1):
            crossed |= across[bj * size + k]
        whole[bj] = (crossed == 0) & (count >= least)
    right, below = nodes.right[bi], nodes.below[bi : bi + 1]
    for bj in range(len(right)):
        right[bj] = 2 * joined[(bj + 1) * size - 1] >= size
    for i in range(len(below)):
        for bj in range(len(whole)):
            touching = 0
            for k in range(size):
                touching += columns[5, bj * size + k]
            below[i, bj] = 2 * touching >= size


@njit(cache=True, nogil=True)
def _weigh(
    i: int,
    blocks: Blocks,
    whole: NDArray[np.bool_],
    sensor: SensorModel,
    least: int,
    nodes: Nodes,
) -> None:
    """Weigh the whole ones of a row of blocks, of at least so many measurements."""
    for j in range(len(whole)):
        count, squared = blocks.moments[i, j, COUNT], blocks.squared[i, j]
        if not whole[j] or count < least:
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
