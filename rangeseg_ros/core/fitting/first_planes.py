"""Planes that regions seem to have, before it is known which of their pixels are doubtful."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.interior import fill, find_loose
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.marks import no_marks
from rangeseg_ros.core.sensing.moments import (
    CHI2,
    COUNT,
    RATIO,
    SIZE,
    add_pixel,
    fit_all,
)
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import ray_of
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance

STRIDE = 2
"""Rows and columns from one pixel that is looked at to the next, where a block has a border."""
# Blocks that a region fills, from which on every other row and column will do elsewhere: a plane
# of a quarter of so many pixels errs by a fifth of the noise of one.
_ENOUGH = 16


class FirstPlanes(NamedTuple):
    """What is known of regions 0...M before their fit.

    Attributes
    ----------
    filled : (rows, columns) uint16
        Region of each block of 4 x 4 pixels that it fills, see `interior.fill`.
    moments : (M + 1, 13) float64
        Weighted. Their numbers are of all pixels of the blocks, as holes make no region smaller.
    theta : (M + 1, 3) float64
        theta . ray = inverse range.
    stride : int
        Rows and columns from one pixel that is looked at to the next, where blocks have borders.
    """

    filled: NDArray[np.uint16]
    moments: NDArray[np.float64]
    theta: NDArray[np.float64]
    stride: int

    @classmethod
    def of(
        cls,
        labels: NDArray[np.uint16],
        image: RangeImage,
        blocks: Blocks,
        sensor: SensorModel,
        stride: int = STRIDE,
    ) -> FirstPlanes:
        """Fit planes to the blocks that regions fill and to pixels where there are none.

        Parameters
        ----------
        labels : (H, W) uint16
            0...M, 0 for no region.
        image : RangeImage
            (H, W).
        blocks : Blocks
            Of the image.
        sensor : SensorModel
        stride : int
            See above.
        """
        filled, count = fill(labels), int(labels.max(initial=0)) + 1
        pixels = labels, filled, image.inverse, image.rays, image.pinhole
        others = blocks, sensor, count, stride
        moments = np.add(*map_halves(_sum_moments, len(filled), *pixels, *others))
        return cls(filled, moments, fit_all(moments)[0], stride)

    def without(self, dropped: NDArray[np.bool_]) -> FirstPlanes:
        """Those of regions that are not `dropped` (M + 1,), never 0, numbered anew."""
        if not dropped.any():
            return self
        table = np.where(dropped, 0, np.cumsum(~dropped) - 1).astype(np.uint16)
        moments, theta = self.moments[~dropped], self.theta[~dropped]
        return FirstPlanes(table[self.filled], moments, theta, self.stride)


@njit(cache=True, nogil=True)
def _sum_moments(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    filled: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    blocks: Blocks,
    sensor: SensorModel,
    count: int,
    stride: int,
) -> NDArray[np.float64]:
    """Moments (count, 13) of each region in some rows of blocks."""
    height, width = labels.shape
    total = np.zeros((count, SIZE))
    for bi in range(first, after):
        for bj in range(filled.shape[1]):
            label, squared = int(filled[bi, bj]), blocks.squared[bi, bj]
            if label == 0 or squared == 0:
                continue
            weight = 1 / random_variance(sensor, squared)
            for entry in range(CHI2 + 1):
                total[label, entry] += weight * blocks.moments[bi, bj, entry]
            total[label, COUNT] += BLOCK**2
            total[label, RATIO] += BLOCK**2 * weight * systematic_variance(sensor, squared)
    known = np.empty(count, np.bool_)
    for label in range(count):
        known[label] = total[label, COUNT] >= _ENOUGH * BLOCK**2
    marks = no_marks(width)
    places = np.empty(len(marks), np.intp)
    for i in range(first * BLOCK, min(after * BLOCK, height)):
        found = find_loose(labels[i], filled[i // BLOCK], marks, places)
        for place in places[:found]:
            j = int(place)
            label, y = int(labels[i, j]), float(inverse[i, j])
            step = stride if known[label] else 1
            if y == 0 or (step > 1 and i % step + j % step > 0):
                continue
            weight = step**2 / random_variance(sensor, y * y)
            ratio = weight * systematic_variance(sensor, y * y)
            add_pixel(total[label], ray_of(rays, pinhole, i, j), y, weight, ratio)
            total[label, COUNT] += step**2
    return total
