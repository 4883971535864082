"""Small holes in the measurements, bridged where the surfaces around them go on."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.range_image import RangeImage

# Pixels from one side of a hole to the other, at most: gaps of three, as random holes in a third
# of the pixels make them, and less than the shadow of any step that is not small itself.
SPAN = 4
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # rows and columns from one pixel to the next


def bridge_holes(
    image: RangeImage, steps: NDArray[np.float32], slopes: NDArray[np.float32]
) -> RangeImage:
    """The image with small holes interpolated.

    A missing pixel lies between two measured ones in its row, column or diagonals. All such pairs
    must continue each other: their inverse ranges differ by no more than a jump and the slope of
    the surface over their distance, which the two sides of a shadow do not. The closest pair is
    interpolated. `steps` and `slopes`, from pixel to pixel, are those of every block, 1/m.
    """
    known = image.valid.view(np.uint8)
    holes = cv2.dilate(known, np.ones((2 * SPAN - 1, 2 * SPAN - 1), np.uint8)) > known
    if not holes.any():
        return image
    inverse = image.inverse.copy()
    # A camera has rays everywhere; those of a cloud lie between its points.
    rays = (image.rays if image.camera is None else image.rays[:0]).copy()
    _bridge(holes, image.inverse, steps, slopes, inverse, rays)
    return replace(image, inverse=inverse, rays=rays if rays.size else image.rays)


@njit(cache=True, nogil=True)
def _bridge(
    holes: NDArray[np.bool_],
    measured: NDArray[np.float32],
    steps: NDArray[np.float32],
    slopes: NDArray[np.float32],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
) -> None:
    """Fill in the holes that are bridged."""
    for i in range(len(measured)):
        for j in range(measured.shape[1]):
            if not holes[i, j]:
                continue
            step, slope = steps[i // BLOCK, j // BLOCK], slopes[i // BLOCK, j // BLOCK]
            best = 2 * SPAN
            for di, dj in _DIRECTIONS:
                back = _distance(measured, i, j, (-di, -dj), SPAN - 1)
                ahead = _distance(measured, i, j, (di, dj), SPAN - back) if back > 0 else 0
                if ahead == 0:
                    continue
                span, share = back + ahead, np.float32(back / (back + ahead))
                bi, bj, ai, aj = i - back * di, j - back * dj, i + ahead * di, j + ahead * dj
                one, other = measured[bi, bj], measured[ai, aj]
                if abs(one - other) > step + slope * span:
                    inverse[i, j] = 0
                    break
                if span < best:
                    best = span
                    inverse[i, j] = one + share * (other - one)
                    for k in range(3 if rays.size > 0 else 0):
                        here, there = rays[bi, bj, k], rays[ai, aj, k]
                        rays[i, j, k] = here + share * (there - here)


@njit(cache=True, inline='always')
def _distance(
    measured: NDArray[np.float32], i: int, j: int, direction: tuple[int, int], most: int
) -> int:
    """Steps to the nearest measured pixel in a direction; 0 where `most` lead to none."""
    height, width = measured.shape
    for k in range(1, most + 1):
        u, v = i + k * direction[0], j + k * direction[1]
        if not (0 <= u < height and 0 <= v < width):
            return 0
        if measured[u, v] > 0:
            return k
    return 0
