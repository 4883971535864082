"""How much of the work is done where there is no time for all of it."""

from __future__ import annotations

from typing import NamedTuple

# Share of the full work, on Kinect frames of 640 x 480, that remains without cuts: of all pixels,
# and of every second row and column; that of these with cuts; and of every fourth, without.
_UNCUT, _COARSE, _COARSE_UNCUT, _COARSEST = 0.95, 0.7, 0.65, 0.45

STEPS = (1.0, _UNCUT, _COARSE, _COARSE_UNCUT, _COARSEST)
"""Budgets that make a difference, falling: those of which docs/benchmark.md tells the accuracy."""


class Work(NamedTuple):
    """What is done of what refines a segmentation.

    Attributes
    ----------
    step : int
        1 where all pixels are looked at; 2, 4: every second, fourth of every such row.
    cuts : float
        Share of the pixels near boundaries whose labels cuts decide, 0...1.
    """

    step: int
    cuts: float

    @classmethod
    def within(cls, budget: float) -> Work:
        """What a share `budget` of the full work, 0...1, is enough for.

        Cuts move boundaries by a pixel here and there, and are the first that goes, a part at a
        time. Then three quarters of the pixels go, and the cuts come back; then go these, and last
        three quarters of what pixels there are.
        """
        if budget >= _UNCUT:
            return cls(1, min((budget - _UNCUT) / (1.0 - _UNCUT), 1.0))
        if budget >= _COARSE_UNCUT:
            return cls(2, min((budget - _COARSE_UNCUT) / (_COARSE - _COARSE_UNCUT), 1.0))
        return cls(4, 0.0)
