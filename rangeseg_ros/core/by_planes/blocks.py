"""The blocks of 2 x 2 pixels that surfaces are grown from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.grid import View
from rangeseg_ros.core.sensing.moments import COUNT, RATIO, SLOPE
from rangeseg_ros.core.sensing.sensor import random_variance, systematic_variance, tilt_variance

NODE = 2
"""Rows and columns of a block: the least that holds a plane."""
# Measurements of a block, those of bridged holes included, and without these: a plane has three.
_LEAST = 3


class Nodes(NamedTuple):
    """The blocks (rows, columns) that surfaces are grown from.

    `moments` (..., 13) have weights according to the sensor, and the ratios of its variances;
    zeros for blocks to leave out: that a jump crosses or that lack two measurements. `residual` is
    what the plane through each leaves, with these weights. `right` (rows, columns - 1) and `below`
    (rows - 1, columns) tell whether a block touches its right, its lower neighbour.
    """

    moments: NDArray[np.float64]
    residual: NDArray[np.float64]
    right: NDArray[np.bool_]
    below: NDArray[np.bool_]

    @classmethod
    def of(cls, view: View) -> Nodes:
        """Those of an image, holes bridged: a row of pixels alone determines no plane."""
        blocks, sensor = Blocks.of(view.whole, NODE), view.sensor
        kept = blocks.moments[..., COUNT] >= _LEAST
        kept[: view.whole.shape[0] // NODE, : view.whole.shape[1] // NODE] &= ~_crossed(view)
        count = kept * blocks.moments[..., COUNT]
        level = random_variance(sensor, blocks.squared)
        tilt = tilt_variance(sensor, blocks.slope) / level
        weight = kept / (level * (1 + tilt))
        moments = blocks.moments
        moments *= weight[..., None]
        moments[..., COUNT] = count
        moments[..., RATIO] = count * weight * systematic_variance(sensor, blocks.squared)
        moments[..., SLOPE] = count * tilt
        # Blocks touch where an edge joins a pixel of one and a pixel of the other.
        across, down = view.grid.right[:, 1::NODE] > 0, view.grid.below[1::NODE] > 0
        right, below = across[::NODE].copy(), down[:, ::NODE].copy()
        right[: len(across) // NODE] |= across[1::NODE]
        below[:, : down.shape[1] // NODE] |= down[:, 1::NODE]
        return cls(moments, weight * blocks.residual, right, below)


def _crossed(view: View) -> NDArray[np.bool_]:
    """Whether a jump parts two measured pixels of a whole block."""
    valid, grid = view.whole.valid, view.grid
    across = valid[:, :-1:NODE] & valid[:, 1::NODE] & (grid.right[:, ::NODE] == 0)
    down = valid[:-1:NODE] & valid[1::NODE] & (grid.below[::NODE] == 0)
    crossed: NDArray[np.bool_] = across[:-1:NODE] | across[1::NODE]
    return crossed | down[:, :-1:NODE] | down[:, 1::NODE]
