"""Vertical bands: steps of the inverse depth at fixed columns, over the whole height.

Sensors that process an image in strips of columns have them, and a smooth field would blur them.
From a column to the next, the residuals of planes change in the mean over rows and frames by the
slope of the smooth distortion, which is alike over neighbouring columns, and by the step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from rangeseg_ros.core.calibration.sightings import Sightings, cell_size
from rangeseg_ros.core.significance import CERTAIN


def column_profile(seen: Sightings) -> NDArray[np.float64]:
    """Error of each column by the steps at columns left of it, (W,) 1/m, of mean zero.

    Of `seen` the jumps count.
    """
    total, count = _without_outliers(seen.jumps).sum(axis=0)
    change = total / np.maximum(count, 1)
    # The slope of the smooth distortion is alike over a cell on either side: a field between cells
    # is linear.
    around = 2 * cell_size((1, len(change) + 1)) + 1
    change -= median_filter(change, around, mode='nearest')
    # Columns seen in few rows are as much noisier.
    noise = change * np.sqrt(count / max(count.max(initial=0), 1))
    spread = 1.4826 * np.median(np.abs(noise[count > 0])) if count.any() else 0.0
    steps = np.where(np.abs(noise) > CERTAIN * max(spread, 1e-12), change, 0.0)
    profile: NDArray[np.float64] = np.concatenate([[0.0], np.cumsum(steps)])
    return profile - profile.mean()


def _without_outliers(jumps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Jumps without those of single frames, as where a wrong region is of two planes."""
    total, count = np.moveaxis(jumps, 1, 0)
    each = np.ma.masked_array(total / np.maximum(count, 1), count == 0)
    # As much noisier as they are of fewer rows.
    off = np.abs(each - np.ma.median(each, axis=0)) * np.sqrt(count)
    kept = off <= CERTAIN * 1.4826 * np.ma.median(off)
    return jumps * np.ma.filled(kept, False)[:, None]
