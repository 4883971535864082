"""The smallest step of the inverse range that is a jump and no noise."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.fitting.noise import ROUGH
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, tilt_variance


class Steps(NamedTuple):
    """Which steps of the inverse range are jumps, of blocks (rows, columns), 1/m.

    Of a block that is not flat, by what is known of the flat ones beside it.
    """

    windows: Singles  # between means of windows: that of the flattest surface
    pixels: Singles  # between pixels, which may be any surface's: of the noisiest
    slopes: Singles  # change from pixel to pixel on the flattest surface


def jump_steps(blocks: Blocks, sensor: SensorModel) -> Steps:
    """Smallest step of the inverse range that is a jump, and the slope of the surface.

    Second differences of means of 3 x 3 pixels, that jump edges are found by, have 0.72 (0.67 to
    0.76) times the variance of `block_inflation`, and five standard deviations are no noise.
    Rounding alone makes steps of one quantum, and of two where noise adds to it.
    """
    squared, slope = blocks.squared, blocks.slope
    variance, freedom = random_variance(sensor, squared), blocks.moments[..., COUNT] - 3
    limit = ROUGH * (variance + tilt_variance(sensor, slope)) * freedom
    flat = (freedom > 0) & (blocks.residual < limit)
    # A jump distorts the slope of its block: take those of flat blocks beside it.
    around = np.ones((3, 3), np.uint8)
    least = np.where(flat, slope, cv2.erode(np.where(flat, slope, np.inf), around))
    most = np.where(flat, slope, cv2.dilate(np.where(flat, slope, 0.0), around))
    least[cv2.dilate(flat.astype(np.uint8), around) == 0] = 0.0
    rounding = 2.2 * np.maximum(sensor.quantum, sensor.range_quantum * squared)
    factor = 25 * 0.72 * sensor.block_inflation
    windows, pixels = (
        np.maximum(np.sqrt(factor * (variance + tilt_variance(sensor, added))), rounding)
        for added in (least, most)
    )
    return Steps(*(values.astype(np.float32) for values in (windows, pixels, np.sqrt(least))))
