"""Events that are not looked for with every message."""

from __future__ import annotations

import time
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup


class SeldomCallbackGroup(MutuallyExclusiveCallbackGroup):
    """Callbacks that the executor looks for at intervals while messages come, and always else.

    For every message the executor asks the middleware anew for all that a node waits for. With
    three events for each publisher that takes longer than to take the message, and the
    interpreter is not there for the segmentation meanwhile. Events that are not looked for wait.

    Parameters
    ----------
    interval : float
        Seconds.
    """

    def __init__(self, interval: float) -> None:
        super().__init__()
        self._interval = interval
        self._looked_for = True
        self._due = 0.0

    def can_execute(self, entity: Any) -> bool:
        """Whether the executor is to look for an event."""
        return self._looked_for and bool(super().can_execute(entity))

    def message_came(self) -> None:
        """Have the executor look only if it has not for an interval."""
        now = time.monotonic()
        self._looked_for = now >= self._due
        if self._looked_for:
            self._due = now + self._interval

    def look(self) -> None:
        """Have the executor look, until the next message comes."""
        self._looked_for = True
