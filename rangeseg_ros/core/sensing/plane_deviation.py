"""Jumps between the planes on either side of a pixel boundary (thesis 2.3, eq. 2.7)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.grid import GridEdges
from rangeseg_ros.core.sensing.marks import find_marked, no_marks
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.significance import OUTLIER

_WINDOW = 3
# The farthest window that a boundary looks at, and rows of means that those of one row need.
_MARGIN = 2 * _WINDOW - 1
_ROWS = 2 * _MARGIN


def plane_deviation(
    image: RangeImage, step: ArrayLike, slope: ArrayLike = 0.0, between: ArrayLike = 0.0
) -> GridEdges:
    """Jumps between the planes on either side of a pixel boundary (thesis 2.3, eq. 2.7).

    In inverse range a plane is a ramp. Along rows and columns, the step between the means of two
    adjoining 3 x 3 windows is compared to the steps on either side of it: on a plane all three
    are equal, over a crease the middle one lies between the others, and only a jump exceeds both.
    Where the deviation exceeds `step`, the boundary runs where the inverse range changes from
    above its local mean to below: the zero crossing, which closes contours by itself.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    step : float or (rows, columns) float
        Deviation that makes a jump, 1/m, of all or of every block of 4 x 4 pixels.
    slope : float or (rows, columns) float
        Change of the inverse range from pixel to pixel on surfaces, 1/m.
    between : float or (rows, columns) float
        As `step`, between two pixels instead of windows; not less than `step`.

    Returns
    -------
    horizontal, vertical : (H, W-1), (H-1, W) bool
        Never true beside a pixel that was not measured.
    """
    height, width = image.shape
    blocks = -(-height // BLOCK), -(-width // BLOCK)
    limits = np.broadcast_to(np.asarray(step, np.float32), blocks).copy()
    # Steps between two pixels that are no noise, and twice as steep as the flat surface around.
    clear = np.float32(OUTLIER) * limits + 2 * np.asarray(slope, np.float32)
    alone = np.maximum(limits, np.asarray(between, np.float32))
    horizontal = np.empty((height, width - 1), np.bool_)
    vertical = np.empty((height - 1, width), np.bool_)
    # Every strip looks once more at the rows around it: as few of them as there are threads.
    arrays = image.inverse, limits, alone, clear, horizontal, vertical
    run_rows(_find_jumps, height, *arrays, strips=1)
    return horizontal, vertical


@njit(cache=True, nogil=True)
def _find_jumps(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    steps: NDArray[np.float32],
    alone: NDArray[np.float32],
    clear: NDArray[np.float32],
    horizontal: NDArray[np.bool_],
    vertical: NDArray[np.bool_],
) -> None:
    """Jumps to the right of and below the pixels of some rows.

    One row after the other, so that what they are told by stays in the cache. A boundary that
    runs along the rows shows in the columns alone, the risers of its staircase too: what counts,
    and makes a pixel strong, is its deviation in either direction.
    """
    height, width = inverse.shape
    mean = np.full((_ROWS, width + 2 * _MARGIN), np.float32(np.nan))
    # Of every second row of blocks in turn: the smallest deviation, the clear step, and the
    # smallest deviation between pixels.
    limit, bound = np.empty((2, width), np.float32), np.empty((2, width), np.float32)
    lone = np.empty((2, width), np.float32)
    # Between each pixel and the one before it, first and last there is none.
    across = np.zeros(width + 1, np.bool_)
    # Of every second row in turn: deviations from the next, strong pixels, their columns and the
    # number of these, and on which side of their local mean they lie.
    down, strong = np.zeros((2, width), np.bool_), np.stack((no_marks(width), no_marks(width)))
    places, count = np.empty(strong.shape, np.int32), np.zeros(2, np.int32)
    side = np.zeros((2, width), np.bool_)
    for k in range(max(first - _MARGIN, 0), min(first + _MARGIN - 1, height)):
        _find_means(k, inverse, mean[k % _ROWS])
    for i in range(first - 1, min(after + 1, height)):
        ahead = i + _MARGIN
        if ahead < height:
            _find_means(ahead, inverse, mean[ahead % _ROWS])
        else:
            mean[ahead % _ROWS] = np.float32(np.nan)
        block = max(i, 0) // BLOCK
        if i % BLOCK == 0 or i < first:
            for j in range(width):
                limit[block % 2, j] = steps[block, j // BLOCK]
                lone[block % 2, j] = alone[block, j // BLOCK]
                bound[block % 2, j] = clear[block, j // BLOCK]
        # Boundaries with the next row: the windows around the last row but one and so on.
        if 0 <= i < height - 1:
            _leave(
                mean[(i - 4) % _ROWS, _MARGIN:],
                mean[(i - 1) % _ROWS, _MARGIN:],
                mean[(i + 2) % _ROWS, _MARGIN:],
                mean[(i + 5) % _ROWS, _MARGIN:],
                limit[block % 2],
                down[i % 2],
            )
        else:
            down[i % 2] = False
        if i < first:
            continue
        row, now = mean[i % _ROWS, _MARGIN - 4 :], i % 2
        _leave(row, row[3:], row[6:], row[9:], limit[block % 2], across[1:width])
        for j in range(width):
            strong[now, j] = down[0, j] | down[1, j] | across[j] | across[j + 1]
        count[now] = find_marked(strong[now], 0, places[now])
        if count[now] > 0:
            _find_sides(i, inverse, places[now, : count[now]], side[now])
        if i < after:
            _cross_right(i, inverse, strong, side, places, count, lone, bound, horizontal[i])
        if i > first:
            _cross_down(i - 1, inverse, strong, side, places, count, lone, bound, vertical[i - 1])


@njit(cache=True, nogil=True, error_model='numpy')
def _find_means(i: int, inverse: NDArray[np.float32], mean: NDArray[np.float32]) -> None:
    """Means of windows of 3 x 3 pixels around those of a row, NaN where nothing was measured.

    `mean` has a margin, in which it keeps what it holds.
    """
    height, width = inverse.shape
    total, count = np.zeros(width + 2, np.float32), np.zeros(width + 2, np.float32)
    sums, known = total[1:-1], count[1:-1]
    above, here, below = inverse[max(i - 1, 0)], inverse[i], inverse[min(i + 1, height - 1)]
    # Outside of the image there is nothing.
    upper, lower = np.float32(i > 0), np.float32(i + 1 < height)
    for j in range(width):
        a, b, c = upper * above[j], here[j], lower * below[j]
        sums[j] = a + b + c
        known[j] = np.float32(a > 0) + np.float32(b > 0) + np.float32(c > 0)
    for j in range(width):
        # 0 / 0 where there is none.
        mean[_MARGIN + j] = (total[j] + total[j + 1] + total[j + 2]) / (
            count[j] + count[j + 1] + count[j + 2]
        )


@njit(cache=True, nogil=True)
def _leave(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    c: NDArray[np.float32],
    d: NDArray[np.float32],
    step: NDArray[np.float32],
    result: NDArray[np.bool_],
) -> None:
    """Whether the steps from b to c lie outside those from a to b and from c to d so far.

    A side that was not measured (NaN) is left out.
    """
    # Without branches, so that the compiler takes many at a time.
    for j in range(len(result)):
        limit = step[j]
        here = c[j] - b[j]
        before, after = here - (b[j] - a[j]), here - (d[j] - c[j])
        first, last = before != before, after != after
        above = ((before > limit) | first) & ((after > limit) | last)
        below = ((before < -limit) | first) & ((after < -limit) | last)
        result[j] = (above | below) & ~(first & last)


@njit(cache=True, nogil=True)
def _find_sides(
    i: int, inverse: NDArray[np.float32], places: NDArray[np.int32], side: NDArray[np.bool_]
) -> None:
    """Whether pixels at some places of a row are nearer than the mean of the 7 x 7 around them."""
    height, width = inverse.shape
    top, bottom = max(i - _WINDOW, 0), min(i + _WINDOW + 1, height)
    # Of the columns, each once; in float64, in which no order of the sum rounds.
    total, count = np.empty(width), np.empty(width, np.int32)
    summed = 0
    for j in places:
        left, right = max(j - _WINDOW, 0), min(j + _WINDOW + 1, width)
        for m in range(max(left, summed), right):
            around, measured = 0.0, 0
            for k in range(top, bottom):
                around += np.float64(inverse[k, m])
                measured += inverse[k, m] > 0
            total[m], count[m] = around, measured
        summed = right
        around, measured = 0.0, 0
        for m in range(left, right):
            around += total[m]
            measured += count[m]
        side[j] = inverse[i, j] * np.float32(measured) > np.float32(around)


# Boundaries are crossed between strong pixels on unlike sides of the local mean, and at every
# clear step, because where three surfaces meet, two may lie on the same side of the mean. At
# corners, where the windows hold little of one surface, contours would have gaps: beside strong
# pixels, the pixels by themselves are looked at as the windows are.


@njit(cache=True, nogil=True)
def _cross_right(
    i: int,
    inverse: NDArray[np.float32],
    strong: NDArray[np.uint8],
    side: NDArray[np.bool_],
    places: NDArray[np.int32],
    count: NDArray[np.int32],
    limit: NDArray[np.float32],
    bound: NDArray[np.float32],
    result: NDArray[np.bool_],
) -> None:
    """Jumps between the pixels of a row."""
    width = inverse.shape[1]
    now, block = i % 2, i // BLOCK % 2
    row = np.zeros(width + 2, np.float32)
    row[1:-1] = inverse[i]
    a, b, c, d = row, row[1:], row[2:], row[3:]
    _step_clearly(a, b, c, d, bound[block], limit[block], result)
    for k in range(count[now]):
        for j in range(max(places[now, k] - 1, 0), min(places[now, k] + 1, width - 1)):
            if b[j] == 0 or c[j] == 0:
                continue
            both = strong[now, j] & strong[now, j + 1]
            result[j] |= (both and side[now, j] != side[now, j + 1]) or _stands_out(
                a[j], b[j], c[j], d[j], limit[block, j]
            )


@njit(cache=True, nogil=True)
def _cross_down(
    i: int,
    inverse: NDArray[np.float32],
    strong: NDArray[np.uint8],
    side: NDArray[np.bool_],
    places: NDArray[np.int32],
    count: NDArray[np.int32],
    limit: NDArray[np.float32],
    bound: NDArray[np.float32],
    result: NDArray[np.bool_],
) -> None:
    """Jumps between the pixels of a row and those below."""
    height, width = inverse.shape
    block = i // BLOCK % 2
    nothing = np.zeros(width, np.float32)
    a = inverse[i - 1] if i > 0 else nothing
    b, c = inverse[i], inverse[i + 1]
    d = inverse[i + 2] if i + 2 < height else nothing
    _step_clearly(a, b, c, d, bound[block], limit[block], result)
    for now in range(2):
        for k in range(count[now]):
            j = places[now, k]
            if b[j] == 0 or c[j] == 0:
                continue
            both = strong[0, j] & strong[1, j]
            result[j] |= (both and side[0, j] != side[1, j]) or _stands_out(
                a[j], b[j], c[j], d[j], limit[block, j]
            )


@njit(cache=True, nogil=True)
def _step_clearly(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    c: NDArray[np.float32],
    d: NDArray[np.float32],
    clear: NDArray[np.float32],
    step: NDArray[np.float32],
    result: NDArray[np.bool_],
) -> None:
    """Whether the steps from b to c are clear, and no part of a slope.

    That is what the one from a to b, or that from c to d, continues to within `step`: of a face
    so narrow that no block tells its slope. What was not measured (0) continues nothing.
    """
    # Without branches, so that the compiler takes many at a time.
    for j in range(len(result)):
        here = c[j] - b[j]
        before, after = abs(here - (b[j] - a[j])), abs(here - (d[j] - c[j]))
        continued = ((a[j] > 0) & (before <= step[j])) | ((d[j] > 0) & (after <= step[j]))
        result[j] = (b[j] > 0) & (c[j] > 0) & (abs(here) > clear[j]) & ~continued


@njit(cache=True, nogil=True)
def _stands_out(a: np.float32, b: np.float32, c: np.float32, d: np.float32, step: float) -> bool:
    """Whether the step from b to c leaves those from a to b and c to d by more than `step`.

    On the same side of both; one that was not measured (0) is left out.
    """
    here = c - b
    if a == 0 and d == 0:
        return False
    before = here - (b - a) if a > 0 else here - (d - c)
    after = here - (d - c) if d > 0 else before
    return bool(min(before, after) > step or max(before, after) < -step)
