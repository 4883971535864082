"""The 4-connected grid of pixels and its neighbourhood weights u of eq. 5.1 (thesis 5.5)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.jump_edges import GridEdges
from rangeseg_ros.core.sensing.range_image import RangeImage


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
    valid = image.valid
    horizontal = (valid[:, 1:] & valid[:, :-1]).astype(np.float32)
    vertical = (valid[1:] & valid[:-1]).astype(np.float32)
    if weighting == 'distance':
        points = image.points
        across = np.linalg.norm(points[:, 1:] - points[:, :-1], axis=2)
        down = np.linalg.norm(points[1:] - points[:-1], axis=2)
        known = np.concatenate([across[horizontal > 0], down[vertical > 0]])
        median = np.median(known) if known.size else np.float32(1)
        with np.errstate(invalid='ignore'):
            horizontal = np.where(horizontal > 0, 2 * median / (median + across), 0)
            vertical = np.where(vertical > 0, 2 * median / (median + down), 0)
    if jumps is not None:
        horizontal[jumps[0]] = 0
        vertical[jumps[1]] = 0
    return Grid(horizontal, vertical)
