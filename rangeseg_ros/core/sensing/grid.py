"""The 4-connected grid of pixels (thesis 5.5), and the view.

A `View` is a range image with what is known of it before planes are looked for.
"""

from __future__ import annotations

from typing import NamedTuple

from rangeseg_ros.core.arrays import Mask
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

# (H, W-1) and (H-1, W) bool: a jump between a pixel and its right, its lower neighbour.
GridEdges = tuple[Mask, Mask]


class Grid(NamedTuple):
    """Edges from each pixel to its right (H, W-1) and lower (H-1, W) neighbour: u of eq. 5.1.

    False where disconnected.
    """

    right: Mask
    below: Mask


class View(NamedTuple):
    """A range image, or its bins, and what is known of it before planes are looked for.

    In `whole` small holes of `image` are bridged; `grid` is of `whole`. `nodes`, blocks of 2 x 2
    pixels of `whole`, are None or overwritten by `Nodes.of`. `min_pixels` is the size of the
    smallest plane, and `area` that of a pixel at inverse range 1, m^2. `identified` is False where
    `sensor` was to be measured and the image shows too little.
    """

    image: RangeImage
    whole: RangeImage
    grid: Grid
    sensor: SensorModel
    min_pixels: int
    area: float
    identified: bool
    nodes: Blocks | None = None


def grid_of(image: RangeImage, jumps: GridEdges | None = None) -> Grid:
    """The grid of an image, with the edges that cross `jumps` disconnected (5.5.2).

    Pixels without measurement are disconnected as well (thesis 6.7).
    """
    valid = image.valid
    right, below = valid[:, 1:] & valid[:, :-1], valid[1:] & valid[:-1]
    return Grid(right & ~jumps[0], below & ~jumps[1]) if jumps else Grid(right, below)
