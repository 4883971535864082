"""Jumps between the planes on either side of a pixel boundary (thesis 2.3, eq. 2.7)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.grid import GridEdges
from rangeseg_ros.core.sensing.marks import no_marks
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.significance import OUTLIER

_WINDOW = 3  # the smallest one
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
    limits = (np.full(blocks, limit, np.float32) for limit in (step, slope, between))
    horizontal = np.empty((height, width - 1), np.bool_)
    vertical = np.empty((height - 1, width), np.bool_)
    # Every strip looks once more at the rows around it: as few of them as there are threads.
    run_rows(_find_jumps, height, image.inverse, *limits, horizontal, vertical, strips=1)
    return horizontal, vertical


@njit(cache=True, nogil=True)
def _find_jumps(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    steps: NDArray[np.float32],
    slopes: NDArray[np.float32],
    between: NDArray[np.float32],
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
    # Sums of three pixels of each column and how many were measured, with a margin of zeros.
    columns = np.zeros((2, width + 2), np.float32)
    # Of every second row of blocks in turn: the smallest deviation, the clear step, and the
    # smallest deviation between pixels.
    limit, bound = np.empty((2, width), np.float32), np.empty((2, width), np.float32)
    lone = np.empty((2, width), np.float32)
    # Between each pixel and the one before it, first and last there is none.
    across = np.zeros(width + 1, np.bool_)
    # Of every second row in turn: deviations from the next, and strong pixels.
    down, strong = np.zeros((2, width), np.bool_), np.stack((no_marks(width), no_marks(width)))
    # Sums of windows of columns, with a margin of zeros; in float64, in which no order of the sum
    # rounds.
    total, count = np.zeros(width + 2 * _WINDOW), np.zeros(width + 2 * _WINDOW, np.int32)
    # A row of pixels between two that were not measured, and a row of these.
    row, nothing = np.zeros(width + 2, np.float32), np.zeros(width, np.float32)
    for k in range(max(first - _MARGIN, 0), min(first + _MARGIN - 1, height)):
        _find_means(k, inverse, columns, mean[k % _ROWS])
    for i in range(first - 1, min(after + 1, height)):
        ahead = i + _MARGIN
        if ahead < height:
            _find_means(ahead, inverse, columns, mean[ahead % _ROWS])
        else:
            mean[ahead % _ROWS] = np.float32(np.nan)
        block, now = max(i, 0) // BLOCK, i % 2
        if i % BLOCK == 0 or i < first:
            for j in range(width):
                step = steps[block, j // BLOCK]
                limit[block % 2, j] = step
                lone[block % 2, j] = max(step, between[block, j // BLOCK])
                # No noise, and twice as steep as the flat surface around.
                clear = np.float32(OUTLIER) * step + np.float32(2) * slopes[block, j // BLOCK]
                bound[block % 2, j] = clear
        # Boundaries with the next row: the windows around the last row but one and so on.
        if 0 <= i < height - 1:
            _leave(
                mean[(i - 4) % _ROWS, _MARGIN:],
                mean[(i - 1) % _ROWS, _MARGIN:],
                mean[(i + 2) % _ROWS, _MARGIN:],
                mean[(i + 5) % _ROWS, _MARGIN:],
                limit[block % 2],
                down[now],
            )
        else:
            down[now] = False
        if i < first:
            continue
        means = mean[i % _ROWS, _MARGIN - 4 :]
        _leave(means, means[3:], means[6:], means[9:], limit[block % 2], across[1:width])
        for j in range(width):
            strong[now, j] = down[0, j] | down[1, j] | across[j] | across[j + 1]
        _tell_sides(i, inverse, total, count, strong[now])
        if i < after:
            row[1:-1] = inverse[i]
            _cross(
                (row, row[1:], row[2:], row[3:]),
                (bound[block % 2], lone[block % 2]),
                (strong[now], strong[now, 1:]),
                horizontal[i],
            )
        if i > first:
            block = (i - 1) // BLOCK
            before = inverse[i - 2] if i > 1 else nothing
            beyond = inverse[i + 1] if i + 1 < height else nothing
            _cross(
                (before, inverse[i - 1], inverse[i], beyond),
                (bound[block % 2], lone[block % 2]),
                (strong[1 - now], strong[now]),
                vertical[i - 1],
            )


@njit(cache=True, nogil=True, error_model='numpy')
def _find_means(
    i: int,
    inverse: NDArray[np.float32],
    columns: NDArray[np.float32],
    mean: NDArray[np.float32],
) -> None:
    """Means of windows of 3 x 3 pixels around those of a row, NaN where nothing was measured.

    `columns` (2, W + 2) and `mean` have a margin, in which they keep what they hold.
    """
    height, width = inverse.shape
    total, count = columns[0], columns[1]
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
def _tell_sides(
    i: int,
    inverse: NDArray[np.float32],
    total: NDArray[np.float64],
    count: NDArray[np.int32],
    strong: NDArray[np.uint8],
) -> None:
    """Mark strong pixels of a row by 2 that are nearer than the mean of the 7 x 7 around them.

    `total` and `count` (W + 6,) have a margin of zeros. Told for runs of eight pixels of which
    one is strong, as the compiler takes many at a time.
    """
    height, width = inverse.shape
    eight, k = strong.view(np.uint64), 0
    while k < len(eight):
        first = 8 * k
        while k < len(eight) and eight[k] > 0:
            k += 1
        after = min(8 * k, width)
        k += 1
        if first >= after:
            continue
        left, right = max(first - _WINDOW, 0), min(after + _WINDOW, width)
        sums, known = total[left + _WINDOW : right + _WINDOW], count[left + _WINDOW :]
        sums[:], known[: len(sums)] = 0, 0
        for m in range(max(i - _WINDOW, 0), min(i + _WINDOW + 1, height)):
            row = inverse[m, left:right]
            for j in range(len(row)):
                sums[j] += np.float64(row[j])
                known[j] += row[j] > 0
        sums, known, row, marks = (
            total[first:],
            count[first:],
            inverse[i, first:after],
            strong[first:],
        )
        for j in range(len(row)):
            around, measured = 0.0, 0
            for m in range(2 * _WINDOW + 1):
                around += sums[j + m]
                measured += known[j + m]
            marks[j] <<= row[j] * np.float32(measured) > np.float32(around)


@njit(cache=True, nogil=True)
def _cross(
    pixels: tuple[NDArray[np.float32], ...],
    limits: tuple[NDArray[np.float32], NDArray[np.float32]],
    strong: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    result: NDArray[np.bool_],
) -> None:
    """Jumps between pixels of a row and those beside them.

    Boundaries are crossed between strong pixels on unlike sides of the local mean, and at every
    clear step, because where three surfaces meet, two may lie on the same side of the mean. At
    corners, where the windows hold little of one surface, contours would have gaps: beside strong
    pixels, the pixels by themselves are looked at as the windows are.

    A step that the one before or after it continues is no clear one: it is part of a face so
    narrow that no block tells its slope. What was not measured (0) continues nothing.

    Parameters
    ----------
    pixels : tuple of 4 (N,) float32
        Inverse ranges before, on either side of and after each boundary.
    limits : tuple of 2 (N,) float32
        The clear step, and by how much two steps differ that do not continue each other.
    strong : tuple of 2 (N,) uint8
        Of the pixels on either side: 0 where they are not, 1 and 2 on either side of the mean.
    result : (N,) bool
    """
    a, b, c, d = pixels
    clear, limit = limits
    one, other = strong
    # Without branches, so that the compiler takes many at a time.
    for j in range(len(result)):
        here, step, marks = c[j] - b[j], limit[j], one[j] | other[j]
        before, after = here - (b[j] - a[j]), here - (d[j] - c[j])
        first, last = a[j] == 0, d[j] == 0
        higher, lower = before > step, before < -step
        rises, falls = after > step, after < -step
        above, below = (first | higher) & (last | rises), (first | lower) & (last | falls)
        apart = (first | higher | lower) & (last | rises | falls)
        jumps = (apart & (abs(here) > clear[j])) | (marks == 3)
        jumps |= (above | below) & ~(first & last) & (marks > 0)
        result[j] = (b[j] > 0) & (c[j] > 0) & jumps
