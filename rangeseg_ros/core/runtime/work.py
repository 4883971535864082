"""How much of the work is done where there is no time for all of it."""

from __future__ import annotations

from typing import NamedTuple

# Share of the full work, on Kinect frames of 640 x 480, that remains without cuts: of all pixels,
# and of every second row and column; and that of these with cuts.
_UNCUT, _COARSE, _COARSE_UNCUT = 0.9, 0.5, 0.46

STEPS = (1.0, (1.0 + _UNCUT) / 2, _UNCUT, _COARSE, _COARSE_UNCUT)
"""Budgets that make a difference, falling: those of which docs/benchmark.md tells the accuracy."""


class Work(NamedTuple):
    """What is done of what refines a segmentation.

    Attributes
    ----------
    every_pixel : bool
        Whether all pixels are looked at, or every second one of every second row.
    cuts : float
        Share of the pixels near boundaries whose labels cuts decide, 0...1.
    """

    every_pixel: bool
    cuts: float

    @classmethod
    def within(cls, budget: float) -> Work:
        """What a share `budget` of the full work, 0...1, is enough for.

        Cuts move boundaries by a pixel here and there, and are the first that goes, a part at a
        time. Then three quarters of the pixels go, and the cuts come back; last go these.
        """
        every_pixel = budget >= _UNCUT
        least, full = (_UNCUT, 1.0) if every_pixel else (_COARSE_UNCUT, _COARSE)
        return cls(every_pixel, min(max((budget - least) / (full - least), 0.0), 1.0))
