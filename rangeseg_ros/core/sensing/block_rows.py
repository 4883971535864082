"""Sums over blocks of pixels and planes through them, many blocks of a row at a time.

What is done with one block is done with those beside it by the same instruction. All that is held
of them meanwhile is one array, the lanes, entry by entry: of several arrays, or of rows of a
length that the compiler does not know, it could not tell that they do not overlap.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.moments import CHI2, COUNT, RATIO, SLOPE, plane_of, plus_pixel

LANES = 32
"""Blocks side by side that are summed and fitted at a time."""
WIDEST = 4
"""Columns of a block, at most."""
# Entries of a block: of a row of its pixels the three coordinates of the rays and the inverse
# ranges, the first eleven of its moments, its plane and what that leaves.
_RAYS, _INVERSE, _SUMS, _THETA, _RESIDUAL = 0, 3 * WIDEST, 4 * WIDEST, 27, 30


@njit(cache=True, nogil=True)
def new_lanes() -> NDArray[np.float64]:
    """Lanes of `LANES` blocks."""
    return np.zeros((_RESIDUAL + 1) * LANES)


@njit(cache=True, nogil=True)
def clear_sums(lanes: NDArray[np.float64]) -> None:
    """Begin with blocks of no pixels."""
    lanes[_SUMS * LANES : _THETA * LANES] = 0


@njit(cache=True, nogil=True)
def set_rays(lanes: NDArray[np.float64], axis: int, row: NDArray[np.float32], size: int) -> None:
    """Take one coordinate (N,) of the rays of a row of pixels, of blocks `size` pixels wide."""
    _deal(lanes, _RAYS + WIDEST * axis, row, size)


@njit(cache=True, nogil=True)
def set_height(lanes: NDArray[np.float64], y: float) -> None:
    """Take one second coordinate for all rays of a row, which a pinhole camera's have."""
    lanes[(_RAYS + WIDEST) * LANES : (_RAYS + 2 * WIDEST) * LANES] = y


@njit(cache=True, nogil=True)
def add_row(lanes: NDArray[np.float64], row: NDArray[np.float32], size: int) -> None:
    """Add pixels of these inverse ranges (N,), and of the rays set, to the sums of the blocks."""
    _deal(lanes, _INVERSE, row, size)
    for b in range(LANES):
        sums, count = _sums(lanes, b), lanes[(_SUMS + COUNT) * LANES + b]
        for k in range(WIDEST):
            y = lanes[(_INVERSE + k) * LANES + b]
            known = y != 0
            # Where nothing was measured there may be no ray.
            x0 = lanes[(_RAYS + k) * LANES + b] if known else 0.0
            x1 = lanes[(_RAYS + WIDEST + k) * LANES + b] if known else 0.0
            x2 = lanes[(_RAYS + 2 * WIDEST + k) * LANES + b] if known else 0.0
            sums = plus_pixel(sums, x0, x1, x2, y, 1.0)
            count += known
        for entry, value in enumerate(sums):
            lanes[(_SUMS + entry) * LANES + b] = value
        lanes[(_SUMS + COUNT) * LANES + b] = count


@njit(cache=True, nogil=True)
def _deal(lanes: NDArray[np.float64], entry: int, row: NDArray[np.float32], size: int) -> None:
    """Deal the pixels of a row out to the blocks, and 0 where it ends."""
    entries = lanes[entry * LANES : (entry + WIDEST) * LANES]
    whole = min(len(row) // size, LANES)
    # Blocks of 4, 3 and 2 pixels, each at a distance that the compiler knows.
    if size == WIDEST:
        for b in range(whole):
            for k in range(WIDEST):
                entries[k * LANES + b] = row[WIDEST * b + k]
    elif size == WIDEST - 1:
        for b in range(whole):
            for k in range(WIDEST - 1):
                entries[k * LANES + b] = row[(WIDEST - 1) * b + k]
    else:
        for b in range(whole):
            for k in range(WIDEST - 2):
                entries[k * LANES + b] = row[(WIDEST - 2) * b + k]
    for b in range(whole, LANES):
        for k in range(size):
            j = b * size + k
            entries[k * LANES + b] = row[j] if j < len(row) else 0.0


@njit(cache=True, nogil=True)
def add_moments(lanes: NDArray[np.float64], blocks: NDArray[np.float64]) -> None:
    """Add a row of blocks (N, 13) to the sums of blocks twice as wide."""
    for j in range(min(len(blocks), 2 * LANES)):
        for entry in range(COUNT + 1):
            lanes[(_SUMS + entry) * LANES + j // 2] += blocks[j, entry]


@njit(cache=True, nogil=True, error_model='numpy')
def fit_sums(lanes: NDArray[np.float64]) -> None:
    """Fit a plane to every block."""
    for b in range(LANES):
        x, y, z, left = plane_of(_sums(lanes, b))
        lanes[_THETA * LANES + b], lanes[(_THETA + 1) * LANES + b] = x, y
        lanes[(_THETA + 2) * LANES + b], lanes[_RESIDUAL * LANES + b] = z, left


@njit(cache=True, nogil=True, error_model='numpy')
def store_sums(
    lanes: NDArray[np.float64],
    moments: NDArray[np.float64],
    squared: NDArray[np.float64],
    residual: NDArray[np.float64],
) -> None:
    """Moments (N, 13) of the blocks, and the attributes (N,) of `Blocks` of these names."""
    for b in range(len(moments)):
        own = moments[b]
        for entry in range(COUNT + 1):
            own[entry] = lanes[(_SUMS + entry) * LANES + b]
        own[RATIO] = own[SLOPE] = 0
    # By themselves, so that the compiler takes many at a time.
    square, count = lanes[(_SUMS + CHI2) * LANES :], lanes[(_SUMS + COUNT) * LANES :]
    left = lanes[_RESIDUAL * LANES :]
    for b in range(len(moments)):
        squared[b] = square[b] / max(count[b], 1.0)
        residual[b] = left[b]


@njit(cache=True, inline='always')
def block_plane(lanes: NDArray[np.float64], b: int) -> tuple[float, float, float]:
    """Plane of a block."""
    begin = _THETA * LANES + b
    return lanes[begin], lanes[begin + LANES], lanes[begin + 2 * LANES]


@njit(cache=True, inline='always')
def _sums(lanes: NDArray[np.float64], b: int) -> tuple[float, ...]:
    """The first ten sums of a block."""
    k = _SUMS * LANES + b
    return (
        lanes[k],
        lanes[k + LANES],
        lanes[k + 2 * LANES],
        lanes[k + 3 * LANES],
        lanes[k + 4 * LANES],
        lanes[k + 5 * LANES],
        lanes[k + 6 * LANES],
        lanes[k + 7 * LANES],
        lanes[k + 8 * LANES],
        lanes[k + 9 * LANES],
    )
