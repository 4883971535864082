"""Steps that a sensor or its driver rounds an image to, told from neighbouring pixels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.alike import median, ranked
from rangeseg_ros.core.significance import CLEARLY

# Rows that tell the quantisation by, and the quantile of steps that is one quantum where there is
# one.
_ROWS, _SMALLEST = 40, 0.1
# Pairs of neighbours that are not the same, at least: a quantile of fewer says nothing.
_PAIRS = 40
# Steps that are no jump, as share of the range: that of a Kinect is 2 % at 8 m.
_COARSEST = 0.05
# Pairs of neighbours that rounding makes the same, for each that it does not, at least.
_SAME = 0.05


@njit(cache=True, nogil=True)
def quantisation(inverse: NDArray[np.float32]) -> tuple[float, float]:
    """Steps of the inverse range, 1/m, and of the range, metres, that an image is rounded to.

    Parameters
    ----------
    inverse : (H, W) float32
        Inverse range, 0 where nothing was measured.

    Returns
    -------
    tuple of 2 float
        One of them at most is not 0.
    """
    height, width = inverse.shape
    stride = max(height // _ROWS, 1)
    step = np.empty(-(-height // stride) * width)
    in_range = np.empty(len(step))
    unlike = same = 0
    for i in range(0, height, stride):
        for j in range(width - 1):
            here, there = inverse[i, j + 1], inverse[i, j]
            if here == 0 or there == 0:
                continue
            if here == there:
                same += 1
            elif abs(here - there) < np.float32(_COARSEST) * here:
                step[unlike] = abs(np.float64(here) - np.float64(there))
                in_range[unlike] = step[unlike] / (np.float64(here) * np.float64(there))
                unlike += 1
    # Without rounding neighbours are hardly ever the same.
    if unlike < _PAIRS or same < _SAME * unlike:
        return 0.0, 0.0
    quantum, clear = _common_step(step[:unlike])
    range_quantum, range_clear = _common_step(in_range[:unlike])
    if max(clear, range_clear) < CLEARLY:
        return 0.0, 0.0
    return (quantum, 0.0) if clear > range_clear else (0.0, range_quantum)


@njit(cache=True)
def _common_step(steps: NDArray[np.float64]) -> tuple[float, float]:
    """The step of which the smaller ones of these are multiples, and how clearly they are."""
    small = ranked(steps.copy(), _SMALLEST)
    near = np.empty(len(steps))
    count = below = 0
    for step in steps:
        # What was rounded twice is off by a little.
        if abs(step - small) < 0.2 * small:
            near[count] = step
            count += 1
        if step < 1.8 * small:
            below += 1
    return median(near[:count]), count / max(below - count, 1)
