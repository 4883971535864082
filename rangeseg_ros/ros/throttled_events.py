"""Callbacks that the executor checks at intervals only."""

from __future__ import annotations

import time
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup


class ThrottledCallbackGroup(MutuallyExclusiveCallbackGroup):
    """Callbacks that are checked at intervals while messages arrive, and always otherwise.

    For every message the executor checks all entities of a node. With three events per publisher
    this takes longer than taking the message, and blocks the interpreter for the segmentation.
    Events that are not checked stay pending. `interval` is in seconds.
    """

    def __init__(self, interval: float) -> None:
        super().__init__()
        self._interval = interval
        self._looked_for = True
        self._due = 0.0

    def can_execute(self, entity: Any) -> bool:
        """Whether the executor checks an event now."""
        return self._looked_for and bool(super().can_execute(entity))

    def message_came(self) -> None:
        """Check events only if the last check is an interval ago."""
        now = time.monotonic()
        self._looked_for = now >= self._due
        if self._looked_for:
            self._due = now + self._interval

    def look(self) -> None:
        """Check events until the next message arrives."""
        self._looked_for = True
