"""Jump edges between neighbouring pixels (thesis 2.2-2.4, 5.5.2), aware of shadows (6.7)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.range_image import RangeImage

# (H, W-1) and (H-1, W) bool: a jump between a pixel and its right, its lower neighbour.
GridEdges = tuple[NDArray[np.bool_], NDArray[np.bool_]]

_WINDOW = 3
# A step between two pixels that needs no look at their surroundings, in units of `step`: steeper
# than all but planes seen edge-on from centimetres away.
_CLEAR = 5


def jump_edges(image: RangeImage, config: Config) -> GridEdges | None:
    """Jump edges by the method that `config` names."""
    if config.jump_edges == 'plane':
        return plane_deviation(image, config.edge_step)
    if config.jump_edges == 'sobel':
        return beside(sobel(image))
    return None


def sobel(image: RangeImage) -> NDArray[np.bool_]:
    """Pixels on thresholded ridges of the depth gradient (thesis 2.2, 2.4, 5.5.2).

    Median filter, Sobel operators, the threshold of eq. 2.6, ridge thinning, morphological
    bridging. Windows that hold a pixel without measurement respond with nothing (section 6.7).

    Parameters
    ----------
    image : RangeImage
        (H, W).

    Returns
    -------
    (H, W) bool
    """
    valid = image.valid
    with np.errstate(divide='ignore'):
        depth = np.where(valid, 1 / image.inverse, 0).astype(np.float32)
    depth = np.where(_complete(valid), cv2.medianBlur(depth, _WINDOW), depth)
    complete = _complete(valid)
    gx = np.where(complete, cv2.Sobel(depth, cv2.CV_32F, 1, 0), 0)
    gy = np.where(complete, cv2.Sobel(depth, cv2.CV_32F, 0, 1), 0)
    strength = gx * gx + gy * gy
    strong = strength > 4 * strength[complete].mean() if complete.any() else complete
    # A ridge is no lower than the pixel before and higher than the one after, across it.
    framed = np.pad(strength, 1)
    left, right = framed[1:-1, :-2], framed[1:-1, 2:]
    upper, lower = framed[:-2, 1:-1], framed[2:, 1:-1]
    steep = np.abs(gx) >= np.abs(gy)
    ridge = np.where(
        steep,
        (strength >= left) & (strength > right),
        (strength >= upper) & (strength > lower),
    )
    return bridged(strong & ridge)


def beside(pixels: NDArray[np.bool_]) -> GridEdges:
    """All edges of the given pixels (H, W): edge pixels are disconnected from everything."""
    return pixels[:, 1:] | pixels[:, :-1], pixels[1:] | pixels[:-1]


def _complete(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels whose 3 x 3 window, as far as it lies in the image, was measured throughout."""
    return cv2.erode(valid.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


# The eight neighbours in a circle, as bits, and the offsets of each: (row, column).
_RING = ((0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0))


def bridged(edges: NDArray[np.bool_]) -> NDArray[np.bool_]:
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


def plane_deviation(image: RangeImage, step: float) -> GridEdges:
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
    step : float
        Deviation that makes a jump, 1/m.

    Returns
    -------
    horizontal, vertical : (H, W-1), (H-1, W) bool
        Never true beside a pixel that was not measured.
    """
    inverse = image.inverse
    valid = image.valid
    mask = valid.astype(np.float32)
    mean = _mean(inverse, mask, _WINDOW)
    above = inverse > _mean(inverse, mask, 2 * _WINDOW + 1)
    across, down = _deviation(mean, step), _deviation(mean.T, step).T
    # A boundary that runs along the rows shows in the columns alone, the risers of its staircase
    # too: what counts is a pixel's deviation in either direction.
    strong = np.zeros(image.shape, bool)
    strong[:, :-1] |= across
    strong[:, 1:] |= across
    strong[:-1] |= down
    strong[1:] |= down
    strong &= valid
    horizontal = (above[:, 1:] != above[:, :-1]) & strong[:, 1:] & strong[:, :-1]
    vertical = (above[1:] != above[:-1]) & strong[1:] & strong[:-1]
    # Where three surfaces meet, two may lie on the same side of the mean.
    horizontal |= (np.abs(np.diff(inverse, axis=1)) > _CLEAR * step) & valid[:, 1:] & valid[:, :-1]
    vertical |= (np.abs(np.diff(inverse, axis=0)) > _CLEAR * step) & valid[1:] & valid[:-1]
    return horizontal, vertical


def _mean(inverse: NDArray[np.float32], mask: NDArray[np.float32], window: int) -> NDArray:
    """Mean of the measured pixels of a window; NaN where there is none."""
    size = (window, window)
    border = cv2.BORDER_CONSTANT
    total = cv2.boxFilter(inverse, -1, size, normalize=False, borderType=border)
    count = cv2.boxFilter(mask, -1, size, normalize=False, borderType=border)
    with np.errstate(invalid='ignore', divide='ignore'):
        mean = total / count
    mean[count < 0.5] = np.nan
    return mean


def _deviation(mean: NDArray[np.float32], step: float) -> NDArray[np.bool_]:
    """Whether the step across each boundary along the rows leaves the steps beside it so far."""
    framed = np.full((mean.shape[0], mean.shape[1] - 1 + 2 * _WINDOW), np.nan, np.float32)
    # Boundary k, between pixels k and k+1: the windows around k-1 and k+2.
    framed[:, _WINDOW + 1 : -_WINDOW - 1] = mean[:, _WINDOW:] - mean[:, :-_WINDOW]
    before = framed[:, : -2 * _WINDOW]
    here = framed[:, _WINDOW:-_WINDOW]
    after = framed[:, 2 * _WINDOW :]
    # fmin and fmax leave out a side that was not measured; comparisons with NaN are false.
    low, high = np.fmin(before, after), np.fmax(before, after)
    return (here - high > step) | (low - here > step)
