"""Jump edges between neighbouring pixels (thesis 2.2-2.4, 5.5.2), aware of shadows (6.7)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.arrays import Mask, Singles
from rangeseg_ros.core.runtime.threads import Task
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.grid import GridEdges
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.significance import OUTLIER

# Rows and columns of the windows of both methods, and of the median before the Sobel operators.
_WINDOW = 3
_FRAME = 2 * _WINDOW - 1  # the farthest window that a boundary looks at
_SOBEL_GAIN = 4  # response of the operator of 3 x 3 to a step of one: 1 + 2 + 1


def jump_edges(image: RangeImage, method: str, *limits: ArrayLike) -> GridEdges | None:
    """Jump edges by method `plane`, `sobel` or `none`; `limits` are those of `plane_deviation`."""
    if method == 'plane':
        return plane_deviation(image, *limits)
    return sobel(image) if method == 'sobel' else None


def plane_deviation(
    image: RangeImage, step: ArrayLike, slope: ArrayLike = 0.0, between: ArrayLike = 0.0
) -> GridEdges:
    """Jumps to the right of pixels (H, W-1) and below (H-1, W) from plane to plane (thesis 2.3).

    In inverse range a plane is a ramp: the step between the means of adjoining 3 x 3 windows is
    that on either side of it, over a crease it lies between these, and only a jump exceeds both.
    The pixels beside such boundaries are candidates. The jump runs between candidates of which
    one lies above the mean of the 7 x 7 pixels around it and one below: the zero crossing, which
    closes contours. At corners, pixels beside candidates are compared as the windows are; where
    three surfaces meet, every clear step that the next one does not continue is a jump, too. No
    jump is beside a pixel that was not measured.

    In 1/m, of the image or of every block of 4 x 4 pixels: the deviation of windows that makes a
    `step`, that `between` two pixels, if larger, and the `slope` of surfaces from pixel to pixel.
    """
    height, width = image.shape
    step, slope, between = (np.asarray(a, np.float32) for a in (step, slope, between))
    # No noise, and twice as steep as the flat surface around.
    clear = np.float32(OUTLIER) * step + 2 * slope
    step, lone, clear = (
        _along_rows(a, image.shape) for a in (step, np.maximum(step, between), clear)
    )
    wide = Task(_window_sums, image, 2 * _WINDOW + 1)
    total, count = _window_sums(image, _WINDOW)
    means = _framed(total / np.maximum(count, 1))
    jumps = np.empty((height, width - 1), np.bool_), np.empty((height - 1, width), np.bool_)
    for down, result in enumerate(jumps):
        _find_deviations(means, step, bool(down), result)
    total, count = wide.result()
    nearer = image.inverse * count > total
    # 1 for candidates below the mean, 2 for those above.
    sides = edge_pixels(jumps).view(np.uint8) << nearer
    pixels = _framed(image.inverse)
    for down, result in enumerate(jumps):
        _find_jumps(pixels, sides, lone, clear, bool(down), result)
    return jumps


def _along_rows(limit: Singles, shape: tuple[int, int]) -> Singles:
    """Values (rows of blocks, W) from one value or those of all blocks."""
    blocks = np.broadcast_to(limit, (-(-shape[0] // BLOCK), -(-shape[1] // BLOCK)))
    return np.ascontiguousarray(blocks.repeat(BLOCK, axis=1)[:, : shape[1]])


def _window_sums(image: RangeImage, size: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Sums of the inverse range and numbers of measured pixels of square windows in the image."""
    total, count = (
        cv2.boxFilter(a, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for a in (image.inverse, image.valid.view(np.uint8))
    )
    return total, count


def _framed(values: NDArray[Any]) -> NDArray[Any]:
    """Values in a frame of zeros."""
    return cv2.copyMakeBorder(values, _FRAME, _FRAME, _FRAME, _FRAME, cv2.BORDER_CONSTANT)


@njit(cache=True, nogil=True)
def _find_deviations(means: Singles, limits: Singles, down: bool, result: Mask) -> None:
    """Whether the windows on either side of boundaries deviate from those beyond."""
    for i in range(len(result)):
        a, b = _shifted(means, i, -4, down), _shifted(means, i, -1, down)
        c, d = _shifted(means, i, 2, down), _shifted(means, i, 5, down)
        row = limits[i // BLOCK]
        for j in range(result.shape[1]):
            result[i, j] = _exceeds(a[j], b[j], c[j], d[j], row[j])[0]


@njit(cache=True, nogil=True)
def _find_jumps(
    pixels: Singles,
    sides: NDArray[np.uint8],
    limits: Singles,
    clear: Singles,
    down: bool,
    result: Mask,
) -> None:
    """Jumps between pixels, see `plane_deviation`."""
    for i in range(len(result)):
        a, b = _shifted(pixels, i, -1, down), _shifted(pixels, i, 0, down)
        c, d = _shifted(pixels, i, 1, down), _shifted(pixels, i, 2, down)
        one, other = sides[i], sides[i + 1] if down else sides[i, 1:]
        row, clear_row = limits[i // BLOCK], clear[i // BLOCK]
        for j in range(result.shape[1]):
            jumps, stands_out = _exceeds(a[j], b[j], c[j], d[j], row[j])
            both = one[j] | other[j]
            jumps = (jumps & (both > 0)) | (stands_out & (abs(c[j] - b[j]) > clear_row[j]))
            result[i, j] = jumps | ((both == 3) & (b[j] > 0) & (c[j] > 0))


@njit(cache=True, inline='always')
def _shifted(values: Singles, i: int, offset: int, down: bool) -> Singles:
    """Row i of framed values, or what lies `offset` further down or to the right."""
    if down:
        return values[_FRAME + i + offset, _FRAME:]
    return values[_FRAME + i, _FRAME + offset :]


@njit(cache=True, inline='always')
def _exceeds(a: float, b: float, c: float, d: float, limit: float) -> tuple[Any, Any]:
    """Whether the step from b to c exceeds those from a to b and from c to d, in one direction.

    And whether it differs from both in any direction. Of a and d, one that was not measured (0) is
    left out; there is no step without b and c.
    """
    # Without branches, so that the compiler takes many at a time.
    here = c - b
    before, after = here - (b - a), here - (d - c)
    first, last, known = a == 0, d == 0, (b > 0) & (c > 0)
    higher, lower = before > limit, before < -limit
    rises, falls = after > limit, after < -limit
    above, below = (first | higher) & (last | rises), (first | lower) & (last | falls)
    apart = (first | higher | lower) & (last | rises | falls)
    return known & (above | below) & ~(first & last), known & apart


def sobel(image: RangeImage) -> GridEdges:
    """Edges (H, W-1), (H-1, W) around ridges of the depth gradient (thesis 2.2, 2.4, 5.5.2).

    Median filter, Sobel operators, the threshold of eq. 2.6, ridge thinning, morphological
    bridging; the pixels of the ridges are disconnected from all of their neighbours. A window that
    holds a pixel without measurement responds with nothing: the change towards a shadow is none
    of depth (section 6.7). But contours must close at a shadow, or what lies before and behind it
    stays connected around its end: bridging counts shadows as edges, and two neighbours are also
    disconnected when the step between them by itself exceeds the threshold, whatever lies around.
    """
    valid = image.valid
    with np.errstate(divide='ignore'):
        depth = np.where(valid, 1 / image.inverse, 0).astype(np.float32)
    complete = cv2.erode(valid.view(np.uint8), np.ones((_WINDOW, _WINDOW), np.uint8)) > 0
    smooth = np.where(complete, cv2.medianBlur(depth, _WINDOW), depth)
    gx, gy = (np.where(complete, cv2.Sobel(smooth, cv2.CV_32F, *d), 0) for d in ((1, 0), (0, 1)))
    strength = gx * gx + gy * gy
    # Infinite where nothing can be told.
    threshold = 2 * np.sqrt(strength[complete].mean()) if complete.any() else np.float32(np.inf)
    # Pixels no lower than the one before along the gradient, and higher than the one after.
    framed = np.pad(strength, 1)
    across = (strength >= framed[1:-1, :-2]) & (strength > framed[1:-1, 2:])
    down = (strength >= framed[:-2, 1:-1]) & (strength > framed[2:, 1:-1])
    ridge = np.where(np.abs(gx) >= np.abs(gy), across, down) & (strength > threshold**2)
    pixels = bridge_edges(ridge | ~valid) & valid
    step = threshold / _SOBEL_GAIN
    horizontal = (np.abs(np.diff(depth, axis=1)) > step) | pixels[:, 1:] | pixels[:, :-1]
    vertical = (np.abs(np.diff(depth, axis=0)) > step) | pixels[1:] | pixels[:-1]
    return horizontal & valid[:, 1:] & valid[:, :-1], vertical & valid[1:] & valid[:-1]


def edge_pixels(edges: GridEdges) -> Mask:
    """Pixels (H, W) that a jump separates from one of their four neighbours or more."""
    right, below = edges
    pixels = np.zeros((len(right), below.shape[1]), np.bool_)
    pixels[:, :-1] = right
    pixels[:, 1:] |= right
    pixels[:-1] |= below
    pixels[1:] |= below
    return pixels


# Bits of the eight neighbours, and which patterns of them fall apart without the centre.
_RING = np.array([[1, 2, 4], [8, 0, 16], [32, 64, 128]])
_PATTERNS = [(_RING & pattern > 0).view(np.uint8) for pattern in range(256)]
_JOINS = np.array([cv2.connectedComponents(ring)[0] > 2 for ring in _PATTERNS])


def bridge_edges(edges: Mask) -> Mask:
    """Add every pixel that joins neighbours which do not touch each other (thesis 2.4)."""
    kernel, pixels = _RING.astype(np.float32), edges.view(np.uint8)
    pattern = cv2.filter2D(pixels, cv2.CV_16S, kernel, borderType=cv2.BORDER_CONSTANT)
    return edges | _JOINS[pattern]
