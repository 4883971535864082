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
    """A range image, as it was measured and with holes bridged (`whole`, which `grid` is of).

    Or its bins. With its blocks of 4 x 4 pixels, its errors, the pixels of the smallest plane
    (`least`), the `area` of a pixel at inverse range 1, m^2, and whether the errors are known: not
    where they were to be measured and the image says too little. `nodes` are blocks of 2 x 2
    pixels of `whole`, which growing surfaces takes for itself; None where they are to be made.
    """

    image: RangeImage
    whole: RangeImage
    blocks: Blocks
    grid: Grid
    sensor: SensorModel
    least: int
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
