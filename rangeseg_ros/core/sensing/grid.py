"""The 4-connected grid of pixels, its neighbourhood weights u (eq. 5.1, thesis 5.5), and the view.

A `View` is a range image with what is known of it before planes are looked for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

# (H, W-1) and (H-1, W) bool: a jump between a pixel and its right, its lower neighbour.
GridEdges = tuple[NDArray[np.bool_], NDArray[np.bool_]]


class Grid(NamedTuple):
    """Weights of the edges from each pixel to its right (H, W-1) and lower (H-1, W) neighbour.

    0 where disconnected.
    """

    right: NDArray[np.float32]
    below: NDArray[np.float32]


class View(NamedTuple):
    """A range image, as it was measured and with holes bridged (`whole`, which `grid` is of).

    Or its bins. With its blocks of 4 x 4 pixels, its errors, the pixels of the smallest plane
    (`least`), the `area` of a pixel at inverse range 1, m^2, and whether the errors are known: not
    where they were to be measured and the image says too little.
    """

    image: RangeImage
    whole: RangeImage
    blocks: Blocks
    grid: Grid
    sensor: SensorModel
    least: int
    area: float
    identified: bool


def weights(image: RangeImage, jumps: GridEdges | None = None, weighting: str = 'uniform') -> Grid:
    """Weights of the edges between neighbouring pixels.

    Pixels without measurement are disconnected (thesis 6.7), and edges that cross a jump (5.5.2).
    The others have 1 ('uniform'), or more the closer the points lie in space ('distance', 5.5.4):
    2 m / (m + d) with the distance d of the points and its median m over the image.
    """
    valid = image.valid
    connected = [valid[:, 1:] & valid[:, :-1], valid[1:] & valid[:-1]]
    if jumps is not None:
        connected = [edges & ~jump for edges, jump in zip(connected, jumps, strict=True)]
    found = [edges.astype(np.float32) for edges in connected]
    if weighting == 'distance':
        apart = [np.linalg.norm(np.diff(image.points, axis=axis), axis=2) for axis in (1, 0)]
        known = np.concatenate([lengths[np.isfinite(lengths)] for lengths in apart])
        median = np.median(known) if known.size else np.float32(1)
        for edges, lengths, weight in zip(connected, apart, found, strict=True):
            weight[edges] = 2 * median / (median + lengths[edges])
    return Grid(*found)
