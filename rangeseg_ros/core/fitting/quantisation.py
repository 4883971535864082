"""Steps that a sensor or its driver rounds an image to, told from neighbouring pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.significance import CLEARLY

# Rows that tell the quantisation by, and the quantile of steps that is one quantum where there is
# one.
_ROWS, _SMALLEST = 20, 0.1
# Pairs of neighbours that are not the same, at least: a quantile of fewer says nothing.
_PAIRS = 40
# Steps that are no jump, as share of the range: that of a Kinect is 2 % at 8 m.
_COARSEST = 0.05
# Pairs of neighbours that rounding makes the same, for each that it does not, at least.
_SAME = 0.05


def quantisation(inverse: NDArray[np.float32]) -> tuple[float, float]:
    """Steps of the inverse range, 1/m, and of the range, metres, that an image is rounded to.

    Of inverse ranges (H, W), 0 where nothing was measured. One of the steps at most is not 0.
    """
    rows = inverse[:: max(len(inverse) // _ROWS, 1)]
    both = (rows[:, 1:] > 0) & (rows[:, :-1] > 0)
    here, there = rows[:, 1:][both].astype(float), rows[:, :-1][both].astype(float)
    step = np.abs(here - there)
    unlike = (step > 0) & (step < _COARSEST * here)
    same, step = len(step) - np.count_nonzero(step), step[unlike]
    # Without rounding neighbours are hardly ever the same.
    if len(step) < _PAIRS or same < _SAME * len(step):
        return 0.0, 0.0
    quantum, clear = _common_step(step)
    range_quantum, range_clear = _common_step(step / (here[unlike] * there[unlike]))
    if max(clear, range_clear) < CLEARLY:
        return 0.0, 0.0
    return (quantum, 0.0) if clear > range_clear else (0.0, range_quantum)


def _common_step(steps: NDArray[np.float64]) -> tuple[float, float]:
    """The step of which the smaller ones of these are multiples, and how clearly they are."""
    rank = int(_SMALLEST * (len(steps) - 1))
    small = np.partition(steps, rank)[rank]
    # What was rounded twice is off by a little.
    near = steps[np.abs(steps - small) < 0.2 * small]
    others = int(np.count_nonzero(steps < 1.8 * small)) - len(near)
    return float(np.median(near)), len(near) / max(others, 1)
