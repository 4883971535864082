"""A range image as planes are looked for in it, at the resolution at which they are."""

from __future__ import annotations

from typing import NamedTuple

from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel


class View(NamedTuple):
    """What is known of a range image before planes are looked for.

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
    step : int
        1 where it has all pixels of the image, n where it has every n-th column of such rows.
    """

    image: RangeImage
    whole: RangeImage
    blocks: Blocks
    grid: Grid
    sensor: SensorModel
    least: int
    step: int

    def every(self, step: int) -> View:
        """Every `step`-th column of every such row, with all jumps between these."""
        image = self.image.every(step)
        return View(
            image,
            self.whole.every(step),
            Blocks.of(image),
            self.grid.every(step),
            self.sensor.magnified(1 / step),
            -(-self.least // step**2),
            self.step * step,
        )
