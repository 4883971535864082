"""How much of the work is done where there is no time for all of it, and how long it takes."""

from __future__ import annotations

import time

# Of bins n times as wide, the budget from which on they are taken (docs/benchmark.md).
_SHARES = {1: 1.0, 2: 0.55, 4: 0.35}

STEPS = tuple(_SHARES.values())
"""Budgets that make a difference, falling."""


def step_within(budget: float) -> int:
    """By how much bins are wider, for a share `budget` of the full work, 0...1."""
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
