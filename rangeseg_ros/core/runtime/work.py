"""How much of the work is done where there is no time for all of it, and how long it takes."""

from __future__ import annotations

import time

# Of every n-th row and column that are segmented, the share of the processor time of all pixels on
# Kinect frames of 640 x 480 (docs/benchmark.md).
_SHARES = {1: 1.0, 2: 0.55, 4: 0.35}

STEPS = tuple(_SHARES.values())
"""Budgets that make a difference, falling."""


def step_within(budget: float) -> int:
    """Rows and columns of which one is looked at, for a share `budget` of the full work, 0...1."""
    return next((step for step, share in _SHARES.items() if budget >= share), max(_SHARES))


class Stopwatch:
    """Times the stages of a run; `laps` are milliseconds per stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End the stage that has been running."""
        now = time.perf_counter()
        self.laps[stage] = 1000 * (now - self._last)
        self._last = now
