"""Jump edges between neighbouring pixels (thesis 2.2-2.4, 5.5.2), aware of shadows (6.7)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.sensing.blocks import for_pixels
from rangeseg_ros.core.sensing.grid import GridEdges
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.significance import OUTLIER

# Rows and columns of the windows of both methods, and of the median before the Sobel operators.
_WINDOW = 3
_SOBEL_GAIN = 4  # response of the operator of 3 x 3 to a step of one: 1 + 2 + 1
# Rows are looked at as they are, columns as rows of the transposed image.
_TURNS = (np.asarray, np.transpose)


def jump_edges(image: RangeImage, method: str, *steps: ArrayLike) -> GridEdges | None:
    """Jump edges by method `plane`, `sobel` or `none`; the first takes the smallest steps."""
    if method == 'plane':
        return plane_deviation(image, *steps)
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
    step, slope, between = (np.asarray(a, np.float32) for a in (step, slope, between))
    # No noise, and twice as steep as the flat surface around.
    clear = np.float32(OUTLIER) * step + 2 * slope
    step, lone, clear = (
        for_pixels(a, image.shape) for a in (step, np.maximum(step, between), clear)
    )
    total, count = _window_sums(image, _WINDOW)
    means = total / np.maximum(count, 1)
    total, count = _window_sums(image, 2 * _WINDOW + 1)
    nearer = image.inverse * count > total
    across, down = (turn(_exceeds(turn(means), _WINDOW, turn(step))[0]) for turn in _TURNS)
    # 1 for candidates below the mean, 2 for those above.
    sides = pixels_beside((across, down)).view(np.uint8) << nearer
    across, down = (
        turn(_crossings(turn(image.inverse), turn(sides), turn(lone), turn(clear)))
        for turn in _TURNS
    )
    return across, down


def _window_sums(image: RangeImage, size: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Sums of the inverse range and numbers of measured pixels of square windows in the image."""
    total, count = (
        cv2.boxFilter(a, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for a in (image.inverse, image.valid.view(np.uint8))
    )
    return total, count


def _crossings(
    inverse: NDArray[np.float32],
    sides: NDArray[np.uint8],
    lone: NDArray[np.float32],
    clear: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Jumps (H, W-1) between pixels and those to their right, see `plane_deviation`."""
    jumps, stands_out = _exceeds(inverse, 1, lone)
    both, (here, there) = sides[:, :-1] | sides[:, 1:], (inverse[:, :-1], inverse[:, 1:])
    jumps = (jumps & (both > 0)) | (stands_out & (np.abs(there - here) > clear[:, :-1]))
    return jumps | ((both == 3) & (here > 0) & (there > 0))


def _exceeds(
    values: NDArray[np.float32], size: int, limit: NDArray[np.float32]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether the step to the right exceeds those before and after it, in one direction (H, W-1).

    And whether it differs from both in any direction. Between means (H, W) of adjoining windows
    of this size. Of those beyond the step, one that was not measured (0) is left out; there is no
    step without the two beside it.
    """
    margin, width = size + size // 2, values.shape[1] - 1
    framed = np.pad(values, ((0, 0), (margin, margin)))
    a, b, c, d = (framed[:, k * size : k * size + width] for k in range(4))
    here, limit = c - b, limit[:, :-1]
    before, after = here - (b - a), here - (d - c)
    first, last, known = a == 0, d == 0, (b > 0) & (c > 0)
    higher, lower = first | (before > limit), first | (before < -limit)
    rises, falls = last | (after > limit), last | (after < -limit)
    jumps = known & ((higher & rises) | (lower & falls)) & ~(first & last)
    return jumps, known & (higher | lower) & (rises | falls)


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
    horizontal = (np.abs(np.diff(depth, axis=1)) > step) & valid[:, 1:] & valid[:, :-1]
    vertical = (np.abs(np.diff(depth, axis=0)) > step) & valid[1:] & valid[:-1]
    horizontal |= pixels[:, 1:] | pixels[:, :-1]
    vertical |= pixels[1:] | pixels[:-1]
    return horizontal, vertical


def pixels_beside(edges: GridEdges) -> NDArray[np.bool_]:
    """Pixels (H, W) that a jump separates from one of their four neighbours or more."""
    right, below = np.pad(edges[0], ((0, 0), (1, 1))), np.pad(edges[1], ((1, 1), (0, 0)))
    pixels: NDArray[np.bool_] = right[:, 1:] | right[:, :-1] | below[1:] | below[:-1]
    return pixels


# Bits of the eight neighbours, and which patterns of them fall apart without the centre.
_RING = np.array([[1, 2, 4], [8, 0, 16], [32, 64, 128]])
_PATTERNS = [(_RING & pattern > 0).view(np.uint8) for pattern in range(256)]
_JOINS = np.array([cv2.connectedComponents(ring)[0] > 2 for ring in _PATTERNS])


def bridge_edges(edges: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Add every pixel that joins neighbours which do not touch each other (thesis 2.4)."""
    kernel, pixels = _RING.astype(np.float32), edges.view(np.uint8)
    pattern = cv2.filter2D(pixels, cv2.CV_16S, kernel, borderType=cv2.BORDER_CONSTANT)
    return edges | _JOINS[pattern]
