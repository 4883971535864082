"""A range image with what is known of it before planes are looked for."""

from __future__ import annotations

from typing import NamedTuple

from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel


class View(NamedTuple):
    """A range image, its blocks, neighbourhood and errors.

    Attributes
    ----------
    image : RangeImage
        (H, W), as it was measured.
    whole : RangeImage
        (H, W), holes bridged.
    blocks : Blocks
        Of 4 x 4 pixels of `image`.
    grid : Grid
        Of `whole`.
    sensor : SensorModel
        Errors of the image.
    least : int
        Pixels of the smallest plane.
    identified : bool
        False where the errors were to be measured and the image says too little.
    """

    image: RangeImage
    whole: RangeImage
    blocks: Blocks
    grid: Grid
    sensor: SensorModel
    least: int
    identified: bool
