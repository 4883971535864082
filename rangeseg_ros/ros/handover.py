"""Between threads: items that wait for what they need, such as transforms; turns in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar('Item')

# Most items that wait: enough for transforms that always come late, few enough for the memory.
_CAPACITY = 12


class LatestReady(Generic[Item]):
    """Gives the newest item that is ready, and drops the items before it.

    An item that is not ready does not block others; it is given once its waiting time is over.
    `delay(item, waited)`: how many more seconds an item has to wait that has waited so long; 0
    when it is ready.
    """

    def __init__(self, delay: Callable[[Item, float], float] = lambda item, waited: 0.0) -> None:
        self._delay = delay
        self._changed = Condition()
        self._items: list[tuple[Item, float]] = []
        self._closed = False

    def put(self, item: Item) -> int:
        """Add an item; the number of items that it replaces."""
        with self._changed:
            self._items.append((item, time.monotonic()))
            ready = self._left(-1) <= 0
            dropped = len(self._items) - (1 if ready else min(len(self._items), _CAPACITY))
            del self._items[:dropped]
            self._changed.notify_all()
            return dropped

    def take(self) -> tuple[Item, int] | None:
        """Wait for a ready item; it, and the number of dropped items. None once closed."""
        with self._changed:
            while not self._closed:
                left = [self._left(k) for k in range(len(self._items))]
                ready = [k for k, seconds in enumerate(left) if seconds <= 0]
                if ready:
                    item, _ = self._items[ready[-1]]
                    del self._items[: ready[-1] + 1]
                    return item, ready[-1]
                self._changed.wait(min(left, default=None))
            return None

    def recheck(self) -> None:
        """Check again whether items are ready."""
        with self._changed:
            self._changed.notify_all()

    def close(self) -> None:
        """Wake all waiting threads; nothing is given any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _left(self, k: int) -> float:
        item, came = self._items[k]
        return self._delay(item, time.monotonic() - came)


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
