"""Planes as the sensor bends them: shifted, from place to place, to what is measured there.

A plane fitted to all of a wall is off by the sensor's distortion where the wall meets another, and
where the two planes intersect is off by several pixels. The distortion is smooth: what a plane
leaves of the blocks around a place is what it leaves here. So a plane theta is taken as the
parallel one, (1 + s) theta, through what was measured of its surface near by.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.moments import RATIO


class Shifts(NamedTuple):
    """Shift s of each plane at the blocks in a box around its surface; 0 elsewhere.

    Attributes
    ----------
    box : (K + 1, 4) int
        First row and column of blocks, rows and columns; empty for label 0.
    start : (K + 1,) int
        Where those of each plane begin in `values`, row by row.
    values : (N,) float32
    """

    box: NDArray[np.intp]
    start: NDArray[np.intp]
    values: NDArray[np.float32]

    @classmethod
    def none(cls, count: int) -> Shifts:
        """No shifts of so many labels, 0 included."""
        return cls(
            np.zeros((count, 4), np.intp), np.zeros(count, np.intp), np.zeros(0, np.float32)
        )


def shifts(
    surfaces: NDArray[np.int32],
    blocks: NDArray[np.float64],
    theta: NDArray[np.float64],
    reach: int,
    around: int,
    agreement: float,
) -> Shifts:
    """Shifts of planes to the blocks of their surfaces.

    With w the weights of pixels and e what theta leaves of them, s is the least-squares solution
    sum(w e theta.r) / sum(w (theta.r)^2) over the blocks around, drawn towards 0 as far as the
    noise of so many pixels explains it: by n / (n + noise / distortion), in variances.

    Parameters
    ----------
    surfaces : (rows, columns) int32
        Surface of each block, 0...K, 0 for none.
    blocks : (rows, columns, 13) float64
        Their moments, weighted.
    theta : (K + 1, 3) float64
        The planes.
    reach : int
        Blocks around a surface that shifts are told for.
    around : int
        Blocks on each side of a place that tell its shift.
    agreement : float
        Pixels whose noise agrees, see `SensorModel.agreement`.
    """
    local = Shifts(*_room_for_shifts(surfaces, len(theta), reach))
    inner = _inner(surfaces)
    map_halves(_find_shifts, len(theta), local, inner, blocks, theta, around, agreement)
    return local


@njit(cache=True, inline='always')
def shift_at(local: Shifts, label: int, row: int, column: int) -> float:
    """Shift of a plane at a block."""
    box = local.box[label]
    i, j = row - box[0], column - box[1]
    if i < 0 or j < 0 or i >= box[2] or j >= box[3]:
        return 0.0
    return local.values[local.start[label] + i * box[3] + j]


@njit(cache=True, nogil=True)
def _room_for_shifts(
    surfaces: NDArray[np.int32], count: int, reach: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Fields of `Shifts`, all 0, in the boxes of the surfaces and so many blocks around them."""
    rows, columns = surfaces.shape
    first = np.full((count, 2), max(rows, columns))
    after = np.zeros((count, 2), np.intp)
    for i in range(rows):
        for j in range(columns):
            k = surfaces[i, j]
            if 0 < j < columns - 1 and surfaces[i, j - 1] == k == surfaces[i, j + 1]:
                continue  # what is between two of the same row is in the box
            first[k, 0], first[k, 1] = min(first[k, 0], i), min(first[k, 1], j)
            after[k, 0], after[k, 1] = max(after[k, 0], i + 1), max(after[k, 1], j + 1)
    box = np.zeros((count, 4), np.intp)
    for k in range(1, count):
        if after[k, 0] > 0:
            box[k, 0], box[k, 1] = max(first[k, 0] - reach, 0), max(first[k, 1] - reach, 0)
            box[k, 2] = min(after[k, 0] + reach, rows) - box[k, 0]
            box[k, 3] = min(after[k, 1] + reach, columns) - box[k, 1]
    end = np.cumsum(box[:, 2] * box[:, 3])
    start = end - box[:, 2] * box[:, 3]
    return box, start, np.zeros(end[-1], np.float32)


@njit(cache=True, nogil=True)
def _inner(surfaces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Surfaces without the blocks beside others, which may hold pixels of these."""
    rows, columns = surfaces.shape
    inner = surfaces.copy()
    for i in range(rows):
        for m in range(max(i - 1, 0), min(i + 2, rows)):
            for step in range(-1, 2):
                # Views, of which the compiler takes many blocks at a time.
                first, after = max(-step, 0), columns - max(step, 0)
                own, kept = surfaces[i, first:after], inner[i, first:after]
                beside = surfaces[m, first + step : after + step]
                for j in range(len(own)):
                    alike = (beside[j] == own[j]) | (beside[j] == 0)
                    kept[j] = kept[j] if alike else np.int32(0)
    return inner


@njit(cache=True, nogil=True)
def _find_shifts(
    first: int,
    after: int,
    local: Shifts,
    inner: NDArray[np.int32],
    blocks: NDArray[np.float64],
    theta: NDArray[np.float64],
    around: int,
    agreement: float,
) -> None:
    """Shifts of some planes in their boxes."""
    for k in range(max(first, 1), after):
        rows, columns = local.box[k, 2], local.box[k, 3]
        own = local.values[local.start[k] : local.start[k] + rows * columns]
        own = own.reshape(rows, columns)
        _shift(k, inner, blocks, theta[k], local.box[k], around, agreement, own)


@njit(cache=True)
def _shift(
    k: int,
    inner: NDArray[np.int32],
    blocks: NDArray[np.float64],
    theta: NDArray[np.float64],
    box: NDArray[np.intp],
    around: int,
    agreement: float,
    result: NDArray[np.float32],
) -> None:
    """Shifts of one plane in its box, from sums over windows of blocks."""
    top, left = box[0], box[1]
    rows, columns = result.shape
    a, b, c = theta
    # Sums over all blocks above and to the left: w e theta.r, w (theta.r)^2, ratio of variances.
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
        first, after = max(i - around, 0), min(i + around + 1, rows)
        for j in range(columns):
            start, end = max(j - around, 0), min(j + around + 1, columns)
            leaves = weight = ratio = 0.0
            for sign, u, v in (
                (1, after, end),
                (-1, first, end),
                (-1, after, start),
                (1, first, start),
            ):
                leaves += sign * total[u, v, 0]
                weight += sign * total[u, v, 1]
                ratio += sign * total[u, v, 2]
            # What is left of none is rounding.
            if weight > 1e-9 * total[rows, columns, 1]:
                result[i, j] = leaves / weight * ratio / (ratio + agreement)
