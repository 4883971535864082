"""A lock that threads get in the order of their tickets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Condition


class TicketLock:
    """Lock whose order is fixed before threads are ready to take it."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._next = self._serving = 0

    def take_ticket(self) -> int:
        """Number of a turn after those of all earlier tickets."""
        with self._changed:
            self._next += 1
            return self._next - 1

    @contextmanager
    def turn(self, ticket: int) -> Iterator[None]:
        """Wait for the turn of a ticket; it ends with the block, also by an exception."""
        with self._changed:
            self._changed.wait_for(lambda: self._serving == ticket)
        try:
            yield
        finally:
            with self._changed:
                self._serving += 1
                self._changed.notify_all()
