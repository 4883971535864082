"""Turns of several threads, in a fixed order."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Condition


class Order:
    """Lets threads have their turns in the order in which they lined up."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._last = self._now = 0

    def line_up(self) -> int:
        """Take the place behind all others; its number."""
        with self._changed:
            self._last += 1
            return self._last - 1

    @contextmanager
    def turn(self, place: int) -> Iterator[None]:
        """Have the turn of `place`, however it ends: the next one's is then."""
        with self._changed:
            self._changed.wait_for(lambda: self._now == place)
        try:
            yield
        finally:
            with self._changed:
                self._now += 1
                self._changed.notify_all()
