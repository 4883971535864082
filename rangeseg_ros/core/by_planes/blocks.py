"""The blocks of 2 x 2 pixels that surfaces are grown from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.grid import View
from rangeseg_ros.core.sensing.moments import COUNT, RATIO, SLOPE
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    random_variance,
    systematic_variance,
    tilt_variance,
)

NODE = 2
"""Rows and columns of a block: the least that holds a plane."""
# Measurements of a block, those of bridged holes included, and without these: a plane has three.
_LEAST = 3


class Nodes(NamedTuple):
    """The blocks that surfaces are grown from.

    Attributes
    ----------
    moments : (rows, columns, 13) float64
        With weights according to the sensor, and the ratios of its variances. Zeros for blocks to
        leave out: that a jump crosses or that lack two measurements.
    residual : (rows, columns) float64
        What the plane through each leaves, with these weights.
    right, below : (rows, columns-1), (rows-1, columns) bool
        Whether a block touches its right, its lower neighbour.
    """

    moments: NDArray[np.float64]
    residual: NDArray[np.float64]
    right: NDArray[np.bool_]
    below: NDArray[np.bool_]

    @classmethod
    def of(cls, view: View) -> Nodes:
        """Those of an image, holes bridged: a row of pixels alone determines no plane."""
        blocks = Blocks.of(view.whole, NODE)
        rows, columns = blocks.squared.shape
        right = np.empty((rows, columns - 1), np.bool_)
        below = np.empty((rows - 1, columns), np.bool_)
        nodes = cls(np.zeros_like(blocks.moments), np.zeros((rows, columns)), right, below)
        run_rows(_fill_in, rows, view.whole.inverse, *view.grid, blocks, view.sensor, nodes)
        return nodes


@njit(cache=True, nogil=True)
def _fill_in(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    right: NDArray[np.float32],
    below: NDArray[np.float32],
    blocks: Blocks,
    sensor: SensorModel,
    nodes: Nodes,
) -> None:
    """Fill in some rows of nodes."""
    height, width = inverse.shape
    for bi in range(first, after):
        for bj in range(nodes.residual.shape[1]):
            i, j = bi * NODE, bj * NODE
            if j + NODE < width:
                one = right[i, j + 1] > 0
                nodes.right[bi, bj] = one | (right[min(i + 1, height - 1), j + 1] > 0)
            if i + NODE < height:
                one = below[i + 1, j] > 0
                nodes.below[bi, bj] = one | (below[i + 1, min(j + 1, width - 1)] > 0)
            if i + 1 < height and j + 1 < width:
                crossed = _parted(inverse[i, j], inverse[i, j + 1], right[i, j])
                crossed |= _parted(inverse[i + 1, j], inverse[i + 1, j + 1], right[i + 1, j])
                crossed |= _parted(inverse[i, j], inverse[i + 1, j], below[i, j])
                crossed |= _parted(inverse[i, j + 1], inverse[i + 1, j + 1], below[i, j + 1])
                if not crossed and blocks.moments[bi, bj, COUNT] >= _LEAST:
                    _weigh(bi, bj, blocks, sensor, nodes)


@njit(cache=True, inline='always')
def _parted(here: float, beside: float, weight: float) -> bool:
    """Whether a jump parts two pixels that were both measured."""
    return (here > 0) & (beside > 0) & (weight == 0)


@njit(cache=True, nogil=True)
def _weigh(i: int, j: int, blocks: Blocks, sensor: SensorModel, nodes: Nodes) -> None:
    """Weigh a block."""
    count, squared = blocks.moments[i, j, COUNT], blocks.squared[i, j]
    level = random_variance(sensor, squared)
    tilt = tilt_variance(sensor, blocks.across[i, j], blocks.down[i, j]) / level
    weight = 1 / (level * (1 + tilt))
    for entry in range(COUNT):
        nodes.moments[i, j, entry] = weight * blocks.moments[i, j, entry]
    nodes.residual[i, j] = weight * blocks.residual[i, j]
    nodes.moments[i, j, COUNT] = count
    nodes.moments[i, j, RATIO] = count * weight * systematic_variance(sensor, squared)
    nodes.moments[i, j, SLOPE] = count * tilt
