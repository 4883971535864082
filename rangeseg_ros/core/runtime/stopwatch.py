"""How long the stages of a run take."""

from __future__ import annotations

import time


class Stopwatch:
    """Times the stages of a run.

    Attributes
    ----------
    laps : dict
        Milliseconds per stage.
    """

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End the stage that has been running."""
        now = time.perf_counter()
        self.laps[stage] = 1000 * (now - self._last)
        self._last = now
