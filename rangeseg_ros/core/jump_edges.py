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


def jump_edges(image: RangeImage, config: Config) -> GridEdges | None:
    """Jump edges by the method that `config` names."""
    if config.jump_edges == 'plane':
        return plane_deviation(image, config.edge_step)
    return None


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
    across, down = _deviation(mean), _deviation(mean.T).T
    horizontal = (across > step) & (above[:, 1:] != above[:, :-1]) & valid[:, 1:] & valid[:, :-1]
    vertical = (down > step) & (above[1:] != above[:-1]) & valid[1:] & valid[:-1]
    return horizontal, vertical


def _mean(
    inverse: NDArray[np.float32], mask: NDArray[np.float32], window: int
) -> NDArray[np.float32]:
    """Mean of the measured pixels of a window; NaN where there is none."""
    size = (window, window)
    border = cv2.BORDER_CONSTANT
    total = cv2.boxFilter(inverse, -1, size, normalize=False, borderType=border)
    count = cv2.boxFilter(mask, -1, size, normalize=False, borderType=border)
    with np.errstate(invalid='ignore', divide='ignore'):
        mean = total / count
    mean[count < 0.5] = np.nan
    return mean


def _deviation(mean: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far the step across each boundary along the rows leaves the steps beside it."""
    step = np.full((mean.shape[0], mean.shape[1] - 1 + 2 * _WINDOW), np.nan, np.float32)
    # Boundary k, between pixels k and k+1: the windows around k-1 and k+2.
    step[:, _WINDOW + 1 : -_WINDOW - 1] = mean[:, _WINDOW:] - mean[:, :-_WINDOW]
    before, here, after = (
        step[:, : -2 * _WINDOW],
        step[:, _WINDOW:-_WINDOW],
        step[:, 2 * _WINDOW :],
    )
    # fmin and fmax leave out a side that was not measured.
    low, high = np.fmin(before, after), np.fmax(before, after)
    return np.nan_to_num(np.fmax(here - high, low - here), nan=0.0)
