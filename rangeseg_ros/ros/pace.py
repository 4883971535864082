"""A frame rate held by doing less of the work."""

from __future__ import annotations

import math
from collections import deque
from statistics import median

from rangeseg_ros.core.sensing.binning import BUDGETS, widening

# Seconds over which times are smoothed: a single slow frame is not followed, and a change of scene
# is (95 % after three times as long) within the five seconds over which rates are counted.
_TIME_CONSTANT = 1.0
# Ratio of the 95th percentile of the times of frames to their median (docs/benchmark.md): 95 % of
# frames are in time where the median frame is faster than the period by this factor.
_HEADROOM = 1.15
# Factor by which the predicted time of a larger share of the work may be wrong: the stated shares
# differ from the measured ones (docs/benchmark.md), and the filter has not settled.
_DOUBT = 1.1
# Seconds for which more work must seem possible before it is done: then 95 % of what is known is
# of the work that is done.
_PATIENCE = 3 * _TIME_CONSTANT


class Pace:
    """Chooses `work_budget` by how long frames take.

    A frame that has taken r seconds with the share b of the work, and o seconds with what is done
    all the same, would just have lasted the period P with the share b (P - o) / r. Its logarithm,
    as a median of three and through a low-pass filter of first order, is what the share is told
    from: the largest of a few steps that is enough at once where that is less, one step more when
    it has been well possible for some time. `rate`, Hz, is to be held (0: none); `most` is the
    largest share of the work, 0...1.
    """

    def __init__(self, rate: float, most: float) -> None:
        self.rate, self.most = rate, most
        less = [b for b in BUDGETS if b < most and widening(b) != widening(most)]
        self._steps = [most, *less]
        self._step = 0
        self._period = 1 / (_HEADROOM * rate) if rate else math.inf
        # Shares beyond twice these limits say no more than the limits.
        self._bounds = _share(self._steps[-1]) / 2, 2 * _share(most)
        self._latest: deque[float] = deque(maxlen=3)
        self._enough = self._bounds[1]
        self._possible = 0.0  # seconds for which more work has seemed so

    @property
    def budget(self) -> float:
        """Share of the work for the next frame."""
        return self._steps[self._step]

    def add(self, refining: float, other: float) -> None:
        """Take up the seconds of a frame: of what `budget` is a share of, and of the rest."""
        share = _share(self.budget) * (self._period - other) / max(refining, 1e-6)
        least, most = self._bounds
        self._latest.append(min(max(share, least), most))
        # A frame stands for the time that it took, or was to take.
        seconds = max(refining + other, self._period)
        kept = math.exp(-seconds / _TIME_CONSTANT)
        self._enough = self._enough**kept * median(self._latest) ** (1 - kept)
        above = self._steps[max(self._step - 1, 0)]
        if self._enough <= _DOUBT * _share(above):
            self._possible = 0.0
        elif self._step > 0:
            self._possible += seconds
        if self._possible > _PATIENCE:
            self._step -= 1
            self._possible = 0.0
        while self._step + 1 < len(self._steps) and self._enough < _share(self.budget):
            self._step += 1


def _share(budget: float) -> float:
    """The share of the work that is done: the largest of the `BUDGETS` within `budget`."""
    return next((step for step in BUDGETS if step <= budget), BUDGETS[-1])
