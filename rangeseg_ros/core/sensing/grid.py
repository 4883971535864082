"""The 4-connected grid of pixels, its neighbourhood weights u (eq. 5.1, thesis 5.5), and the view.

A `View` is a range image with what is known of it before planes are looked for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

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


class View(NamedTuple):
    """A range image, or its bins, with blocks, neighbourhood and errors.

    Attributes
    ----------
    image : RangeImage
        (H, W), as it was measured.
    whole : RangeImage
        (H, W), holes bridged.
    blocks : Blocks
        Of 4 x 4 pixels of `image`.
    grid : Grid
        Of `whole`.
    sensor : SensorModel
        Errors of the image.
    least : int
        Pixels of the smallest plane.
    area : float
        Of a pixel, see `pixel_area`.
    identified : bool
        False where the errors were to be measured and the image says too little.
    """

    image: RangeImage
    whole: RangeImage
    blocks: Blocks
    grid: Grid
    sensor: SensorModel
    least: int
    area: float
    identified: bool


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
    across, down = valid[:, 1:] & valid[:, :-1], valid[1:] & valid[:-1]
    if jumps is not None:
        across, down = across & ~jumps[0], down & ~jumps[1]
    horizontal, vertical = across.astype(np.float32), down.astype(np.float32)
    if weighting == 'distance':
        points = image.points
        width = np.linalg.norm(points[:, 1:] - points[:, :-1], axis=2)
        height = np.linalg.norm(points[1:] - points[:-1], axis=2)
        known = np.concatenate([width[np.isfinite(width)], height[np.isfinite(height)]])
        median = np.median(known) if known.size else np.float32(1)
        with np.errstate(invalid='ignore'):
            horizontal = np.where(across, 2 * median / (median + width), 0)
            vertical = np.where(down, 2 * median / (median + height), 0)
    return Grid(horizontal, vertical)
