"""Small holes in the measurements, bridged where the surfaces around them go on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.range_image import RangeImage

# Pixels from one side of a hole to the other, at most: gaps of three, as random holes in a third
# of the pixels make them, and less than the shadow of any step that is not small itself.
_SPAN = 4


def bridge_holes(
    image: RangeImage, steps: NDArray[np.float32], slopes: NDArray[np.float32]
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
    """
    if image.valid.all():
        return image
    inverse = image.inverse.copy()
    # A camera has rays everywhere; those of a cloud lie between its points.
    known = image.rays if image.camera is None else image.rays[:0]
    rays = known.copy()
    run_rows(_bridge, len(inverse), image.inverse, known, steps, slopes, inverse, rays)
    # Like those it was made from, or every kernel that reads them is compiled twice.
    rays.flags.writeable = False
    return replace(image, inverse=inverse, rays=rays if rays.size else image.rays)


@njit(cache=True, nogil=True)
def _bridge(
    first: int,
    after: int,
    measured: NDArray[np.float32],
    measured_rays: NDArray[np.float32],
    steps: NDArray[np.float32],
    slopes: NDArray[np.float32],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
) -> None:
    """Bridge the holes of some rows."""
    height, width = measured.shape
    # Whether something was measured in a column near the row, and near the pixel: most holes are
    # far from all that was.
    column = np.empty(width + 2 * _SPAN, np.bool_)
    near = np.empty(width, np.bool_)
    for i in range(first, after):
        column[:] = False
        for k in range(max(i - _SPAN + 1, 0), min(i + _SPAN, height)):
            for j in range(width):
                column[j + _SPAN] |= measured[k, j] > 0
        near[:] = False
        for k in range(1, 2 * _SPAN):
            for j in range(width):
                near[j] |= column[j + k]
        for j in range(width):
            if measured[i, j] > 0 or not near[j]:
                continue
            step, slope = steps[i // BLOCK, j // BLOCK], slopes[i // BLOCK, j // BLOCK]
            best, value = 2 * _SPAN, np.float32(0)
            for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
                back, ahead = 0, 0
                for k in range(1, _SPAN):
                    u, v = i - k * di, j - k * dj
                    if not (0 <= u < height and 0 <= v < width):
                        break
                    if measured[u, v] > 0:
                        back = k
                        break
                if back == 0:
                    continue
                for k in range(1, _SPAN + 1 - back):
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
