"""Counts of what happened lately, and of messages that never arrived."""

from __future__ import annotations

import time
from collections import deque
from threading import Lock

WINDOW = 5.0
"""Seconds over which rates and losses are counted."""

FASTEST_CAMERA = 1000.0
"""Hz. No depth camera sends more, so that no more messages can have been lost since the last."""


class Window:
    """Events of the last seconds; used by two threads."""

    def __init__(self) -> None:
        self.total = 0
        self._counts: deque[tuple[float, int]] = deque()
        self._lock = Lock()

    def add(self, count: int = 1) -> None:
        """Count events of now; the memory this takes does not depend on how many."""
        with self._lock:
            self.total += count
            self._counts.append((time.monotonic(), count))
            self._forget()

    def recent(self) -> int:
        """Number of events in the last `WINDOW` seconds."""
        with self._lock:
            self._forget()
            return sum(count for _, count in self._counts)

    def rate(self) -> float:
        """Frequency of the events of the last `WINDOW` seconds, Hz."""
        count = self.recent()
        with self._lock:
            if len(self._counts) < 2:
                return 0.0
            (first, before), (last, _) = self._counts[0], self._counts[-1]
            return (count - before) / (last - first) if last > first else 0.0

    def _forget(self) -> None:
        while self._counts and self._counts[0][0] < time.monotonic() - WINDOW:
            self._counts.popleft()


class Losses:
    """Messages that were sent and did not arrive: `lost`, as the middleware reports.

    Reports with an impossible count (`implausible`) are ignored: Fast DDS reports 2147483647 when
    best-effort messages become smaller after others were lost, besides the true losses. `unseen`
    are gaps in the numbers that the publisher gives to its messages: those that were lost, and
    those that newer ones replaced in the queue of the middleware. None where it tells no numbers,
    or while there are several publishers, whose numbers mix.
    """

    def __init__(self) -> None:
        self.lost = Window()
        self.implausible = 0
        self.unseen: int | None = None
        self._last = time.monotonic()
        self._number: int | None = None

    def report(self, count: int) -> None:
        """Take the middleware's report that so many messages were lost."""
        now = time.monotonic()
        # It notices when a message arrives, so that all of them were sent after the last one.
        if 0 < count <= 1 + FASTEST_CAMERA * (now - self._last):
            self.lost.add(count)
        else:
            self.implausible += 1
        self._last = now

    def arrived(self, number: int | None) -> None:
        """Take the number of the message that has arrived; None where it has none of use."""
        self._last = time.monotonic()
        if number is not None:
            gap = number - self._number - 1 if self._number is not None else 0
            # Numbers that go back are those of a publisher that has started anew.
            self.unseen = (self.unseen or 0) + max(gap, 0)
        self._number = number
