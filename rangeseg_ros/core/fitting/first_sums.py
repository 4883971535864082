"""Sums over regions for the planes that tell which of their pixels are outliers."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.cells import RECORD, add_block, add_pixels
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel


def sums_of_blocks(
    image: RangeImage,
    sensor: SensorModel,
    blocks: Blocks,
    filled: NDArray[np.uint16],
    count: int,
) -> NDArray[np.float64]:
    """Sums over the blocks that regions fill.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    sensor : SensorModel
    blocks : Blocks
        Of the image.
    filled : (rows, columns) uint16
        See `interior.fill`.
    count : int
        M + 1.

    Returns
    -------
    (M + 1, 25) float64
        As of a cell. Zeros for a cloud, as blocks do not tell its points.
    """
    if image.camera is None:
        return np.zeros((count, RECORD))
    return _sum_blocks(filled, blocks, sensor, count)


def first_sums(
    sums: NDArray[np.float64],
    labels: NDArray[np.uint16],
    image: RangeImage,
    sensor: SensorModel,
    area: NDArray[np.intp],
) -> NDArray[np.float64]:
    """Sums over regions that tell which pixels are outliers.

    Over the blocks that a region fills, where these are half of it; otherwise over all pixels.

    Parameters
    ----------
    sums : (M + 1, 25) float64
        Of the blocks, see `sums_of_blocks`.
    labels : (H, W) uint16
        0...M.
    image : RangeImage
        (H, W).
    sensor : SensorModel
    area : (M + 1,) int
        Pixels of each region.

    Returns
    -------
    (M + 1, 25) float64
        As of a cell.
    """
    ragged = 2 * sums[:, COUNT] < area
    ragged[0] = False
    if not ragged.any():
        return sums
    arrays = labels, image.inverse, image.rays, ragged, sensor, image.camera is not None
    pixels = np.add(*map_halves(_sum_pixels, len(labels), *arrays))
    return np.where(ragged[:, None], pixels, sums)


@njit(cache=True, nogil=True)
def _sum_blocks(
    filled: NDArray[np.uint16],
    blocks: Blocks,
    sensor: SensorModel,
    count: int,
) -> NDArray[np.float64]:
    """Sums (count, 25) over the blocks of each region."""
    sums = np.zeros((count, RECORD))
    for i in range(len(filled)):
        for j in range(filled.shape[1]):
            if filled[i, j] > 0 and blocks.squared[i, j] > 0:
                record = sums[filled[i, j]]
                add_block(record, blocks.moments[i, j], blocks.squared[i, j], sensor)
    return sums


@njit(cache=True, nogil=True)
def _sum_pixels(
    top: int,
    bottom: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    chosen: NDArray[np.bool_],
    sensor: SensorModel,
    central: bool,
) -> NDArray[np.float64]:
    """Sums (M + 1, 25) over the measured pixels of chosen regions in some rows."""
    sums = np.zeros((len(chosen), RECORD))
    width = labels.shape[1]
    for i in range(top, bottom):
        j = 0
        while j < width:
            first, label = j, labels[i, j]
            j += 1
            if not chosen[label]:
                continue
            while j < width and labels[i, j] == label:
                j += 1
            add_pixels(sums[label], i, first, j, inverse, rays, sensor, central)
    return sums
