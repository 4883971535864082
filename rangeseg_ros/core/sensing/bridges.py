"""Small holes in the measurements, bridged where the surfaces around them go on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.range_image import RangeImage

SPAN = 4
"""Pixels from one side of a hole to the other, at most.

Gaps of three, as random holes in a third of the pixels make them, and less than the shadow of any
step that is not small itself.
"""
# Rows of the image that one row is told by, and more: a power of two.
_ROWS = 2 * SPAN
# Rows and columns from one pixel to the next.
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))


def bridge_holes(
    image: RangeImage,
    steps: NDArray[np.float32],
    slopes: NDArray[np.float32],
    holes: NDArray[np.int32] | None = None,
) -> RangeImage:
    """The image with small holes interpolated.

    Holes in a pattern come from registration to another camera, confidence masks and interlaced
    readout: they part no surface. A missing pixel lies between two measured ones in its row,
    column or diagonals. All such pairs must continue each other: their inverse ranges differ by
    no more than a jump and the slope of the surface over their distance. The two sides of a
    shadow do not. The closest pair is interpolated.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    steps, slopes : (ceil(H / 4), ceil(W / 4)) float32
        Smallest jump, and the change of the inverse range from pixel to pixel on surfaces, of
        every block, 1/m.
    holes : (N,) int32, optional
        See `find_holes`, where they are known.
    """
    if holes is None:
        holes = find_holes(image.inverse)
    if not len(holes):
        return image
    inverse = np.empty(image.shape, np.float32)
    # A camera has rays everywhere; those of a cloud lie between its points.
    known = image.rays if image.camera is None else image.rays[:0]
    rays = known.copy()
    run_rows(_bridge, len(inverse), holes, image.inverse, known, steps, slopes, inverse, rays)
    # Like those it was made from, or every kernel that reads them is compiled twice.
    rays.flags.writeable = False
    return replace(image, inverse=inverse, rays=rays if rays.size else image.rays)


@njit(cache=True, nogil=True)
def find_holes(measured: NDArray[np.float32]) -> NDArray[np.int32]:
    """Pixels that were not measured and lie between two that were, at most `SPAN` apart.

    Parameters
    ----------
    measured : (H, W) float32
        Inverse range, 0 where nothing was measured.

    Returns
    -------
    (N,) int32
        Numbers of the pixels, in raster order.
    """
    height, width = measured.shape
    places, count = np.empty(height * width, np.int32), 0
    # Whether pixels were measured, of the rows around one and with a margin; and which of the
    # row's were not but lie between two that were: most holes are far from all that was. Bytes,
    # of which the compiler takes more at a time than of truth values.
    known = np.zeros((_ROWS, width + 2 * SPAN), np.uint8)
    between = np.zeros((width + 7) // 8 * 8, np.uint8)
    eight = between.view(np.uint64)
    for i in range(-SPAN, height):
        _find_known(i + SPAN, measured, known[(i + SPAN) % _ROWS, SPAN:])
        if i < 0:
            continue
        here, missing = known[i % _ROWS, SPAN:], 0
        for j in range(width):
            missing += int(here[j] ^ 1)
        if missing == 0:
            continue
        between[:] = 0
        for di, dj in _DIRECTIONS:
            _find_between(
                known[(i - di) % _ROWS, SPAN - dj :],
                known[(i - 2 * di) % _ROWS, SPAN - 2 * dj :],
                known[(i - 3 * di) % _ROWS, SPAN - 3 * dj :],
                known[(i + di) % _ROWS, SPAN + dj :],
                known[(i + 2 * di) % _ROWS, SPAN + 2 * dj :],
                known[(i + 3 * di) % _ROWS, SPAN + 3 * dj :],
                between[:width],
            )
        for j in range(width):
            between[j] &= here[j] ^ 1
        for k in range(len(eight)):
            if eight[k] > 0:
                for j in range(8 * k, min(8 * k + 8, width)):
                    places[count] = i * width + j
                    count += int(between[j])
    return places[:count].copy()


@njit(cache=True, nogil=True)
def _bridge(
    first: int,
    after: int,
    holes: NDArray[np.int32],
    measured: NDArray[np.float32],
    measured_rays: NDArray[np.float32],
    steps: NDArray[np.float32],
    slopes: NDArray[np.float32],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
) -> None:
    """Copy some rows and bridge their holes."""
    height, width = measured.shape
    inverse[first:after] = measured[first:after]
    for place in holes:
        i, j = place // width, place % width
        if not first <= i < after:
            continue
        step, slope = steps[i // BLOCK, j // BLOCK], slopes[i // BLOCK, j // BLOCK]
        best, value = 2 * SPAN, np.float32(0)
        for di, dj in _DIRECTIONS:
            back, ahead = 0, 0
            for k in range(1, SPAN):
                u, v = i - k * di, j - k * dj
                if not (0 <= u < height and 0 <= v < width):
                    break
                if measured[u, v] > 0:
                    back = k
                    break
            if back == 0:
                continue
            for k in range(1, SPAN + 1 - back):
                u, v = i + k * di, j + k * dj
                if not (0 <= u < height and 0 <= v < width):
                    break
                if measured[u, v] > 0:
                    ahead = k
                    break
            span = back + ahead
            if ahead == 0:
                continue
            bi, bj, ai, aj = i - back * di, j - back * dj, i + ahead * di, j + ahead * dj
            one, other = measured[bi, bj], measured[ai, aj]
            if abs(one - other) > step + slope * span:
                value = np.float32(0)
                break
            if span >= best:
                continue
            best, share = span, np.float32(back / span)
            value = one + share * (other - one)
            if rays.size > 0:
                for k in range(3):
                    here, there = measured_rays[bi, bj, k], measured_rays[ai, aj, k]
                    rays[i, j, k] = here + share * (there - here)
        inverse[i, j] = value


@njit(cache=True, nogil=True)
def _find_known(i: int, measured: NDArray[np.float32], known: NDArray[np.uint8]) -> None:
    """Which pixels of a row were measured; none outside of the image."""
    known[:] = 0
    if 0 <= i < len(measured):
        for j in range(measured.shape[1]):
            known[j] = measured[i, j] > 0


@njit(cache=True, nogil=True)
def _find_between(
    back: NDArray[np.uint8],
    back2: NDArray[np.uint8],
    back3: NDArray[np.uint8],
    ahead: NDArray[np.uint8],
    ahead2: NDArray[np.uint8],
    ahead3: NDArray[np.uint8],
    between: NDArray[np.uint8],
) -> None:
    """Add the pixels with measured ones behind and ahead of them, at most `SPAN` apart.

    Those behind and ahead in one direction, by 1, 2 and 3 pixels, are given apart.
    """
    for j in range(len(between)):
        near = ahead[j] | ahead2[j]
        between[j] |= (back[j] & (near | ahead3[j])) | (back2[j] & near) | (back3[j] & ahead[j])
