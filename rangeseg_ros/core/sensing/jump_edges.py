"""Jump edges between neighbouring pixels (thesis 2.2-2.4, 5.5.2), aware of shadows (6.7)."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.runtime.threads import run_rows, submit
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.range_image import RangeImage

# (H, W-1) and (H-1, W) bool: a jump between a pixel and its right, its lower neighbour.
GridEdges = tuple[NDArray[np.bool_], NDArray[np.bool_]]

_WINDOW = 3
# The farthest window that a boundary looks at.
_MARGIN = 2 * _WINDOW - 1
# A step between two pixels that needs no look at their surroundings, in units of `step`
# and of the slope: steeper than all but planes seen edge-on from centimetres away.
_CLEAR = 5
# Response of the Sobel operator of 3 x 3 to a step of one: 1 + 2 + 1.
_SOBEL_GAIN = 4


def jump_edges(
    image: RangeImage, method: str, step: ArrayLike, slope: ArrayLike = 0.0
) -> GridEdges | None:
    """Jump edges by method `plane`, `sobel` or `none`; the first takes the smallest step."""
    if method == 'plane':
        return plane_deviation(image, step, slope)
    if method == 'sobel':
        return sobel(image)
    return None


def sobel(image: RangeImage) -> GridEdges:
    """Edges around thresholded ridges of the depth gradient (thesis 2.2, 2.4, 5.5.2).

    Median filter, Sobel operators, the threshold of eq. 2.6, ridge thinning, morphological
    bridging; the pixels of the ridges are disconnected from all of their neighbours. A window that
    holds a pixel without measurement responds with nothing: the change towards a shadow is none
    of depth (section 6.7). But contours must close at a shadow, or what lies before and behind it
    stays connected around its end: bridging counts shadows as edges, and two neighbours are also
    disconnected when the step between them by itself exceeds the threshold, whatever lies around.

    Parameters
    ----------
    image : RangeImage
        (H, W).

    Returns
    -------
    horizontal, vertical : (H, W-1), (H-1, W) bool
    """
    valid = image.valid
    with np.errstate(divide='ignore'):
        depth = np.where(valid, 1 / image.inverse, 0).astype(np.float32)
    complete = _complete(valid)
    smooth = np.where(complete, cv2.medianBlur(depth, _WINDOW), depth)
    gx = np.where(complete, cv2.Sobel(smooth, cv2.CV_32F, 1, 0), 0)
    gy = np.where(complete, cv2.Sobel(smooth, cv2.CV_32F, 0, 1), 0)
    strength = gx * gx + gy * gy
    # Infinite where nothing can be told.
    threshold = 2 * np.sqrt(strength[complete].mean()) if complete.any() else np.float32(np.inf)
    ridge = _ridges(strength, np.abs(gx) >= np.abs(gy)) & (strength > threshold**2)
    pixels = bridge_edges(ridge | ~valid) & valid
    horizontal, vertical = beside(pixels)
    # A step between two columns or rows responds with the sum of the kernel's one side.
    step = threshold / _SOBEL_GAIN
    horizontal |= (np.abs(np.diff(depth, axis=1)) > step) & valid[:, 1:] & valid[:, :-1]
    vertical |= (np.abs(np.diff(depth, axis=0)) > step) & valid[1:] & valid[:-1]
    return horizontal, vertical


def _ridges(strength: NDArray[np.float32], across: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels no lower than the one before and higher than the one after, along the gradient.

    `across` (H, W) says where that runs along the rows, elsewhere along the columns.
    """
    framed = np.pad(strength, 1)
    left, right = framed[1:-1, :-2], framed[1:-1, 2:]
    upper, lower = framed[:-2, 1:-1], framed[2:, 1:-1]
    return np.where(
        across,
        (strength >= left) & (strength > right),
        (strength >= upper) & (strength > lower),
    )


def beside(pixels: NDArray[np.bool_]) -> GridEdges:
    """All edges of the given pixels (H, W): edge pixels are disconnected from everything."""
    return pixels[:, 1:] | pixels[:, :-1], pixels[1:] | pixels[:-1]


def pixels_beside(edges: GridEdges) -> NDArray[np.bool_]:
    """Pixels (H, W) that a jump separates from one of their four neighbours or more."""
    right, below = (np.pad(edges[0], ((0, 0), (0, 1))), np.pad(edges[1], ((0, 1), (0, 0))))
    pixels: NDArray[np.bool_] = right | below
    pixels[:, 1:] |= edges[0]
    pixels[1:] |= edges[1]
    return pixels


def _complete(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels whose 3 x 3 window, as far as it lies in the image, was measured throughout."""
    return cv2.erode(valid.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


# The eight neighbours in a circle, as bits, and the offsets of each: (row, column).
_RING = ((0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0))


def bridge_edges(edges: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Add every pixel that joins neighbours which do not touch each other (thesis 2.4)."""
    kernel = np.zeros((3, 3), np.float32)
    for bit, position in enumerate(_RING):
        kernel[position] = 1 << bit
    pattern = cv2.filter2D(
        edges.astype(np.uint8), cv2.CV_16S, kernel, borderType=cv2.BORDER_CONSTANT
    )
    return edges | _JOINS[pattern]


def _joins(pattern: int) -> bool:
    """Whether the neighbours set in a pattern of eight bits fall apart without the centre."""
    ring = np.zeros((3, 3), np.uint8)
    for bit, position in enumerate(_RING):
        ring[position] = pattern >> bit & 1
    return cv2.connectedComponents(ring, connectivity=8)[0] > 2


_JOINS = np.array([_joins(pattern) for pattern in range(256)])


def plane_deviation(image: RangeImage, step: ArrayLike, slope: ArrayLike = 0.0) -> GridEdges:
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

    Returns
    -------
    horizontal, vertical : (H, W-1), (H-1, W) bool
        Never true beside a pixel that was not measured.
    """
    inverse = image.inverse
    blocks = -(-image.shape[0] // BLOCK), -(-image.shape[1] // BLOCK)
    limits = np.broadcast_to(np.asarray(step, np.float32), blocks).copy()
    clear = _CLEAR * limits + 2 * np.asarray(slope, np.float32)
    wide = submit(_window_sums, inverse, 2 * _WINDOW + 1)
    height, width = image.shape
    mean = np.full((height + 2 * _MARGIN, width + 2 * _MARGIN), np.float32(np.nan))
    run_rows(_find_means, height, inverse, mean)
    strong = np.zeros((height, width), np.bool_)
    run_rows(_find_strong, height, mean, limits, strong)
    horizontal = np.zeros((height, width - 1), np.bool_)
    vertical = np.zeros((height - 1, width), np.bool_)
    run_rows(
        _find_crossings,
        height,
        inverse,
        strong,
        *wide.result(),
        limits,
        clear,
        horizontal,
        vertical,
    )
    return horizontal, vertical


def _window_sums(
    inverse: NDArray[np.float32], size: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sum and number of the measurements in the window around each pixel."""
    window, border = (size, size), cv2.BORDER_CONSTANT
    mask = (inverse > 0).astype(np.float32)
    total = cv2.boxFilter(inverse, -1, window, normalize=False, borderType=border)
    count = cv2.boxFilter(mask, -1, window, normalize=False, borderType=border)
    return np.asarray(total), np.asarray(count)


@njit(cache=True, nogil=True, error_model='numpy')
def _find_means(
    first: int, after: int, inverse: NDArray[np.float32], mean: NDArray[np.float32]
) -> None:
    """Means of windows of 3 x 3 pixels around those of some rows, NaN where nothing was measured.

    `mean` has a margin, in which it keeps what it holds.
    """
    height, width = inverse.shape
    total, count = np.zeros(width + 2, np.float32), np.zeros(width + 2, np.float32)
    for i in range(first, after):
        total[:], count[:] = 0, 0
        for k in range(max(i - 1, 0), min(i + 2, height)):
            for j in range(width):
                total[j + 1] += inverse[k, j]
                count[j + 1] += np.float32(inverse[k, j] > 0)
        result = mean[i + _MARGIN, _MARGIN : _MARGIN + width]
        for j in range(width):
            # 0 / 0 where there is none.
            result[j] = (total[j] + total[j + 1] + total[j + 2]) / (
                count[j] + count[j + 1] + count[j + 2]
            )


@njit(cache=True, nogil=True)
def _find_strong(
    first: int,
    after: int,
    mean: NDArray[np.float32],
    step: NDArray[np.float32],
    strong: NDArray[np.bool_],
) -> None:
    """Pixels at which the step to some neighbour leaves the steps beside it by more than `step`.

    A boundary that runs along the rows shows in the columns alone, the risers of its staircase
    too: what counts is a pixel's deviation in either direction.
    """
    height, width = strong.shape
    leaving = np.zeros(width, np.bool_)
    below = np.zeros(width, np.bool_)
    limit = np.empty(width, np.float32)
    for i in range(first - 1, after):
        for j in range(width):
            limit[j] = step[max(i, 0) // BLOCK, j // BLOCK]
        # Boundaries with the next pixel: the windows around the last but one and so on.
        k = i + _MARGIN
        above, below = below, np.zeros(width, np.bool_)
        if 0 <= i < height - 1:
            columns = mean[:, _MARGIN : _MARGIN + width]
            _leave(columns[k - 4], columns[k - 1], columns[k + 2], columns[k + 5], limit, below)
        if i < first:
            continue
        row = mean[k, _MARGIN - 4 :]
        _leave(row, row[3:], row[6:], row[9:], limit, leaving[: width - 1])
        for j in range(width):
            strong[i, j] = above[j] | below[j] | leaving[j]
        for j in range(1, width):
            strong[i, j] |= leaving[j - 1]


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
def _find_crossings(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    strong: NDArray[np.bool_],
    total: NDArray[np.float32],
    count: NDArray[np.float32],
    steps: NDArray[np.float32],
    clear: NDArray[np.float32],
    horizontal: NDArray[np.bool_],
    vertical: NDArray[np.bool_],
) -> None:
    """Edges between strong pixels on unlike sides of the local mean, and all of a clear step.

    The latter because where three surfaces meet, two may lie on the same side of the mean. At
    corners, where the windows hold little of one surface, contours would have gaps: beside strong
    pixels, the pixels by themselves are looked at as the windows are.
    """
    height, width = inverse.shape
    for i in range(first, after):
        for j in range(width):
            here = inverse[i, j]
            if here == 0:
                continue
            above = here * count[i, j] > total[i, j]
            step, limit = steps[i // BLOCK, j // BLOCK], clear[i // BLOCK, j // BLOCK]
            if j + 1 < width and inverse[i, j + 1] > 0:
                there = inverse[i, j + 1]
                left = inverse[i, j - 1] if j > 0 else np.float32(0)
                right = inverse[i, j + 2] if j + 2 < width else np.float32(0)
                either, both = strong[i, j] | strong[i, j + 1], strong[i, j] & strong[i, j + 1]
                horizontal[i, j] = (
                    abs(here - there) > limit
                    or (both and above != (there * count[i, j + 1] > total[i, j + 1]))
                    or (either and _stands_out(left, here, there, right, step))
                )
            if i + 1 < height and inverse[i + 1, j] > 0:
                there = inverse[i + 1, j]
                upper = inverse[i - 1, j] if i > 0 else np.float32(0)
                lower = inverse[i + 2, j] if i + 2 < height else np.float32(0)
                either, both = strong[i, j] | strong[i + 1, j], strong[i, j] & strong[i + 1, j]
                vertical[i, j] = (
                    abs(here - there) > limit
                    or (both and above != (there * count[i + 1, j] > total[i + 1, j]))
                    or (either and _stands_out(upper, here, there, lower, step))
                )


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
