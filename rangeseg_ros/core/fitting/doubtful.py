"""Pixels that may not belong to their region: outliers and rims.

A fit takes each pixel once: where it is surely the region's, as one that the region's first plane
does not explain, or as one so near to another region that it may be that one's.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.cells import RECORD, Cells, add_block, add_pixels, cell_of
from rangeseg_ros.core.fitting.interior import RIM, rows_of_blocks
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.moments import COUNT, squares_left
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import ray_of
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    random_variance,
    systematic_variance,
)
from rangeseg_ros.core.significance import OUTLIER

# Kinds of pixels.
_SURE, _OUTLYING, _AT_RIM = 0, 1, 2


def sums_without_doubtful(
    cells: Cells,
    labels: NDArray[np.uint16],
    image: RangeImage,
    theta: NDArray[np.float64],
    sensor: SensorModel,
    blocks: Blocks,
    inner: NDArray[np.uint16],
) -> tuple[Cells, NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Sum up the measured pixels but those that may not belong to regions: outliers, then rims.

    Outliers are the pixels that the planes `theta` (M + 1, 3) do not explain. A region keeps them
    where they are more than half of it, as it is then the sensor model that does not fit, and its
    rim, where that would take the rest to less than half.

    Parameters
    ----------
    cells : Cells
        Empty, of M + 1 regions.
    labels, image, sensor, blocks
        As for `FirstPlanes.of`.
    theta : (M + 1, 3) float64
        First planes.
    inner : (rows, columns) uint16
        Blocks inside regions, see `interior`.

    Returns
    -------
    cells : Cells
    pixels, outliers : (M + 1,) int
        Numbers of measured pixels, and of outliers, whether left out or kept.
    explained : (M + 1, 25) float64
        Sums over whole regions, with their rims.
    """
    central = image.camera is not None
    pixels = labels, image.inverse, image.rays, image.pinhole
    forward = image.camera.axes[:, 2].copy() if image.camera is not None else np.zeros(3)
    regions = blocks, inner, cells, sensor, theta, central, forward
    (count, upper), (lower_count, lower) = map_halves(_sort, len(labels), *pixels, *regions)
    count += lower_count
    explained = np.zeros((len(theta), RECORD))
    map_halves(_leave_out, len(theta), cells, count, upper, lower, explained)
    return cells, count[0], count[_OUTLYING], explained


@njit(cache=True, nogil=True)
def _sort(
    top: int,
    bottom: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    blocks: Blocks,
    inner: NDArray[np.uint16],
    cells: Cells,
    sensor: SensorModel,
    theta: NDArray[np.float64],
    central: bool,
    forward: NDArray[np.float64],
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Numbers and sums of pixels of some rows by their kinds.

    The numbers of all pixels, of outliers and of the rest of the rim, (3, M + 1), and the sums
    over the sure ones, over the outliers and over that rest, (3, N, 25).
    """
    width = labels.shape[1]
    count = np.zeros((3, len(theta)), np.intp)
    sums = np.zeros((3, len(cells.sums), RECORD))
    explained = np.zeros(inner.shape, np.bool_)
    first_block, after_block = rows_of_blocks(top, bottom)
    for bi in range(max(first_block - 1, 0), after_block):
        for bj in range(inner.shape[1]):
            label, squared = inner[bi, bj], blocks.squared[bi, bj]
            # Rays of a cloud are not of one length along any axis: blocks do not tell their sums.
            if label == 0 or not central or cells.size[label] % BLOCK > 0:
                continue
            variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
            # No pixel is farther off than all together.
            left = squares_left(blocks.moments[bi, bj], theta[label])
            explained[bi, bj] = left <= OUTLIER**2 * variance or not _has_outliers(
                bi * BLOCK, bj * BLOCK, inverse, rays, pinhole, sensor, theta[label]
            )
            if explained[bi, bj] and bi >= first_block and squared > 0:
                count[0, label] += int(blocks.moments[bi, bj, COUNT])
                record = sums[_SURE, cell_of(cells, label, bi * BLOCK, bj * BLOCK)]
                add_block(record, blocks.moments[bi, bj], squared, sensor, forward)
    for i in range(top, bottom):
        within, inside = explained[i // BLOCK], inner[i // BLOCK]
        j = 0
        while j < width:
            if within[j // BLOCK]:
                j = (j // BLOCK + 1) * BLOCK
                continue
            first, label = j, int(labels[i, j])
            j += 1
            if label == 0 or inverse[i, first] == 0:
                continue
            kind = _kind(i, first, labels, inverse, rays, pinhole, inside, sensor, theta)
            size = cells.size[label]
            end = min(first + size - (first - cells.origin[label, 1]) % size, width)
            pixels = 1
            while j < end and labels[i, j] == label and not within[j // BLOCK]:
                if inverse[i, j] > 0:
                    if _kind(i, j, labels, inverse, rays, pinhole, inside, sensor, theta) != kind:
                        break
                    pixels += 1
                j += 1
            count[0, label] += pixels
            if kind != _SURE:
                count[kind, label] += pixels
            record = sums[kind, cell_of(cells, label, i, first)]
            add_pixels(record, i, first, j, inverse, rays, pinhole, sensor, central)
    return count, sums


@njit(cache=True, nogil=True)
def _leave_out(
    first: int,
    after: int,
    cells: Cells,
    count: NDArray[np.intp],
    upper: NDArray[np.float64],
    lower: NDArray[np.float64],
    explained: NDArray[np.float64],
) -> None:
    """Sums of some regions, to `cells` and `explained`: what `sums_without_doubtful` returns.

    Of what `_sort` found in the upper and in the lower rows, and the numbers of both.
    """
    total = np.empty((3, RECORD))
    for k in range(first, after):
        pixels, outliers = count[0, k], count[_OUTLYING, k]
        kept, few = 2 * outliers > pixels, 2 * (outliers + count[_AT_RIM, k]) <= pixels
        total[:] = 0
        for c in range(cells.start[k], cells.start[k + 1]):
            for entry in range(RECORD):
                sure = upper[_SURE, c, entry] + lower[_SURE, c, entry]
                outlying = upper[_OUTLYING, c, entry] + lower[_OUTLYING, c, entry]
                rim = upper[_AT_RIM, c, entry] + lower[_AT_RIM, c, entry]
                total[_SURE, entry] += sure
                total[_OUTLYING, entry] += outlying
                total[_AT_RIM, entry] += rim
                if kept:
                    sure += outlying
                if not few:
                    sure += rim
                cells.sums[c, entry] = sure
        explained[k] = total[_SURE] + total[_AT_RIM]
        if kept:
            explained[k] += total[_OUTLYING]


@njit(cache=True)
def _has_outliers(
    top: int,
    left: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    sensor: SensorModel,
    theta: NDArray[np.float64],
) -> bool:
    """Whether any measured pixel of a whole block is beyond what its plane explains."""
    found = False
    # Without branches, so that the compiler takes many at a time.
    for i in range(top, top + BLOCK):
        for j in range(left, left + BLOCK):
            y = float(inverse[i, j])
            x0, x1, x2 = ray_of(rays, pinhole, i, j)
            residual = y - theta[0] * x0 - theta[1] * x1
            residual -= theta[2] * x2
            squared = y * y
            variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
            found |= (y > 0) & (residual * residual > OUTLIER**2 * variance)
    return found


@njit(cache=True, inline='always')
def _kind(
    i: int,
    j: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    inside: NDArray[np.uint16],
    sensor: SensorModel,
    theta: NDArray[np.float64],
) -> int:
    """Kind of a measured pixel; `inside` are the blocks inside regions of its row of blocks."""
    label, y = labels[i, j], float(inverse[i, j])
    # No views of a ray and a plane: their references would be counted for every pixel.
    x0, x1, x2 = ray_of(rays, pinhole, i, j)
    residual = y - theta[label, 0] * x0 - theta[label, 1] * x1
    residual -= theta[label, 2] * x2
    squared = y * y
    variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
    above, below = max(i - RIM, 0), min(i + RIM, labels.shape[0] - 1)
    left, right = max(j - RIM, 0), min(j + RIM, labels.shape[1] - 1)
    # Without branches: no processor foretells them.
    alike = (labels[above, left] == label) & (labels[above, right] == label)
    alike &= (labels[below, left] == label) & (labels[below, right] == label)
    kind = _SURE if alike | (inside[j // BLOCK] > 0) else _AT_RIM
    return _OUTLYING if residual * residual > OUTLIER**2 * variance else kind
