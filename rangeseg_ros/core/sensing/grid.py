"""The 4-connected grid of pixels and its neighbourhood weights u of eq. 5.1 (thesis 5.5)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.range_image import RangeImage

# (H, W-1) and (H-1, W) bool: a jump between a pixel and its right, its lower neighbour.
GridEdges = tuple[NDArray[np.bool_], NDArray[np.bool_]]


class Grid(NamedTuple):
    """Weights of the edges between neighbouring pixels, 0 where disconnected.

    Attributes
    ----------
    right : (H, W-1) float32
        Of the edges from each pixel to its right neighbour.
    below : (H-1, W) float32
        Of those to the one below.
    """

    right: NDArray[np.float32]
    below: NDArray[np.float32]


def weights(image: RangeImage, jumps: GridEdges | None = None, weighting: str = 'uniform') -> Grid:
    """Weights of the edges between neighbouring pixels.

    Parameters
    ----------
    image : RangeImage
        (H, W); pixels without measurement are disconnected (thesis 6.7).
    jumps : (horizontal, vertical) of bool, optional
        Edges that cross a jump and are disconnected (thesis 5.5.2).
    weighting : {'uniform', 'distance'}
        1 for each edge, or more the closer the points lie in space (thesis 5.5.4):
        2 m / (m + d) with the distance d of the points and its median m over the image.

    Returns
    -------
    Grid
    """
    height, width = image.shape
    if jumps is None:
        jumps = np.zeros((height, width - 1), np.bool_), np.zeros((height - 1, width), np.bool_)
    horizontal, vertical = (np.empty(edges.shape, np.float32) for edges in jumps)
    # On this thread alone: to hand rows over takes longer than to do them.
    _connect(image.inverse, *jumps, horizontal, vertical)
    if weighting == 'distance':
        points = image.points
        across = np.linalg.norm(points[:, 1:] - points[:, :-1], axis=2)
        down = np.linalg.norm(points[1:] - points[:-1], axis=2)
        known = np.concatenate([across[np.isfinite(across)], down[np.isfinite(down)]])
        median = np.median(known) if known.size else np.float32(1)
        with np.errstate(invalid='ignore'):
            horizontal = np.where(horizontal > 0, 2 * median / (median + across), 0)
            vertical = np.where(vertical > 0, 2 * median / (median + down), 0)
    return Grid(horizontal, vertical)


@njit(cache=True, nogil=True)
def _connect(
    inverse: NDArray[np.float32],
    across: NDArray[np.bool_],
    down: NDArray[np.bool_],
    right: NDArray[np.float32],
    below: NDArray[np.float32],
) -> None:
    """Give 1 to edges between measured pixels that do not jump, 0 to others."""
    height, width = inverse.shape
    for i in range(height):
        for j in range(width - 1):
            both = (inverse[i, j] > 0) & (inverse[i, j + 1] > 0)
            right[i, j] = both & ~across[i, j]
        if i + 1 < height:
            for j in range(width):
                both = (inverse[i, j] > 0) & (inverse[i + 1, j] > 0)
                below[i, j] = both & ~down[i, j]
