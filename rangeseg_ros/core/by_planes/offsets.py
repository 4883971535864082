"""Planes as the sensor bends them: moved, from place to place, to what is measured there.

The distortion is smooth: what a plane leaves of the blocks around a place is what it leaves here.
So a plane theta is taken as the parallel one, (1 + s) theta, through what was measured of its
surface near by. Without, a crease of two planes would be off by several pixels.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Indices, Ints, Singles
from rangeseg_ros.core.fitting.region_sums import find_boxes
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.moments import RATIO


class Offsets(NamedTuple):
    """Offset s of each plane at the blocks in a box around its surface; 0 elsewhere.

    `box` (K + 1, 4) are the first row and column of blocks, rows and columns; empty for label 0.
    Those of each plane begin in `values` at `start` (K + 1,), row by row.
    """

    box: Indices
    start: Indices
    values: Singles

    @classmethod
    def none(cls, count: int) -> Offsets:
        """No offsets of so many labels, 0 included."""
        box, start = np.zeros((count, 4), np.intp), np.zeros(count, np.intp)
        return cls(box, start, np.zeros(0, np.float32))


def local_offsets(
    surfaces: Ints, blocks: Floats, theta: Floats, reach: int, around: int, block_inflation: float
) -> Offsets:
    """Offsets of planes (K + 1, 3) to the blocks of their surfaces (rows, columns), 0 for none.

    With w the weights of pixels and e what theta leaves of them, s is the least-squares solution
    sum(w e theta.r) / sum(w (theta.r)^2) over the blocks `around` on each side, of weighted
    moments (rows, columns, 13), drawn towards 0 by n / (n + noise / distortion), in variances.
    Offsets are computed up to `reach` blocks around a surface.
    """
    box = find_boxes(surfaces, len(theta))
    corner = np.maximum(box[:, :2] - reach, 0)
    extent = np.minimum(box[:, 2:] + reach, surfaces.shape) - corner
    extent[box[:, 2] == 0] = 0
    end = np.cumsum(extent.prod(axis=1))
    start = end - extent.prod(axis=1)
    local = Offsets(np.hstack([corner, extent]), start, np.zeros(end[-1], np.float32))
    map_halves(
        _find_offsets, len(theta), local, _inner(surfaces), blocks, theta, around, block_inflation
    )
    return local


@njit(cache=True, inline='always')
def offset_at(local: Offsets, label: int, row: int, column: int) -> float:
    """Offset of a plane at a block."""
    box = local.box[label]
    i, j = row - box[0], column - box[1]
    if i < 0 or j < 0 or i >= box[2] or j >= box[3]:
        return 0.0
    return local.values[local.start[label] + i * box[3] + j]


def _inner(surfaces: Ints) -> Ints:
    """Surfaces without the blocks beside others, which may hold pixels of these."""
    # Of no surface the highest number, which is never the least of some.
    window, below = np.ones((3, 3), np.uint8), (surfaces - 1).astype(np.uint16)
    most, least = cv2.dilate(below + np.uint16(1), window), cv2.erode(below, window)
    inner: Ints = surfaces * (most == least + np.uint16(1))
    return inner


@njit(cache=True, nogil=True)
def _find_offsets(
    first: int,
    after: int,
    local: Offsets,
    inner: Ints,
    blocks: Floats,
    theta: Floats,
    around: int,
    block_inflation: float,
) -> None:
    """Fill in the offsets of planes first...after, from sums over windows of blocks."""
    window = np.empty(3)
    for k in range(max(first, 1), after):
        top, left, rows, columns = local.box[k]
        own = local.values[local.start[k] : local.start[k] + rows * columns]
        result = own.reshape(rows, columns)
        a, b, c = theta[k]
        # Sums over all above and to the left: w e theta.r, w (theta.r)^2, ratio of variances.
        total = np.zeros((rows + 1, columns + 1, 3))
        for i in range(rows):
            leaves = weight = ratio = 0.0
            for j in range(columns):
                if inner[top + i, left + j] == k:
                    m = blocks[top + i, left + j]
                    square = a * (m[0] * a + 2 * (m[1] * b + m[2] * c))
                    square += b * (m[3] * b + 2 * m[4] * c) + c * m[5] * c
                    leaves += a * m[6] + b * m[7] + c * m[8] - square
                    weight += square
                    ratio += m[RATIO]
                total[i + 1, j + 1, 0] = total[i, j + 1, 0] + leaves
                total[i + 1, j + 1, 1] = total[i, j + 1, 1] + weight
                total[i + 1, j + 1, 2] = total[i, j + 1, 2] + ratio
        for i in range(rows):
            high, low = max(i - around, 0), min(i + around + 1, rows)
            for j in range(columns):
                near, far = max(j - around, 0), min(j + around + 1, columns)
                for n in range(3):
                    window[n] = total[low, far, n] - total[high, far, n] - total[low, near, n]
                    window[n] += total[high, near, n]
                leaves, weight, ratio = window
                # What is left of none is rounding.
                if weight > 1e-9 * total[rows, columns, 1]:
                    result[i, j] = leaves / weight * ratio / (ratio + block_inflation)
