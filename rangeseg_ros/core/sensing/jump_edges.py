"""Jump edges between neighbouring pixels (thesis 2.2-2.4, 5.5.2), aware of shadows (6.7)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.sensing.grid import GridEdges
from rangeseg_ros.core.sensing.plane_deviation import plane_deviation
from rangeseg_ros.core.sensing.range_image import RangeImage

# Rows and columns of the windows of the Sobel operators and of the median before them.
_WINDOW = 3
# Response of the Sobel operator of 3 x 3 to a step of one: 1 + 2 + 1.
_SOBEL_GAIN = 4


def jump_edges(
    image: RangeImage,
    method: str,
    step: ArrayLike,
    slope: ArrayLike = 0.0,
    between: ArrayLike = 0.0,
) -> GridEdges | None:
    """Jump edges by method `plane`, `sobel` or `none`; the first takes the smallest steps."""
    if method == 'plane':
        return plane_deviation(image, step, slope, between)
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
