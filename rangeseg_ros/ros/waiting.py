"""Frames that wait for what they need: the newest that has it comes first."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar('Item')

# Items that wait at most: so long that transforms that always come late do not starve, and so few
# that images do not fill the memory.
_MOST = 12


class WaitingRoom(Generic[Item]):
    """Hands out the newest item that is ready, and drops those before it.

    An item that is not ready never blocks another, and is handed out once its patience ends.

    Parameters
    ----------
    delay : callable
        (item, seconds waited) -> seconds for which it is to wait on, 0 when it is ready.
    """

    def __init__(self, delay: Callable[[Item, float], float] = lambda item, waited: 0.0) -> None:
        self._delay = delay
        self._changed = Condition()
        self._items: list[tuple[Item, float]] = []
        self._closed = False

    def put(self, item: Item) -> int:
        """Let `item` wait; how many items it takes the place of."""
        with self._changed:
            self._items.append((item, time.monotonic()))
            ready = self._left(-1) <= 0
            dropped = len(self._items) - (1 if ready else min(len(self._items), _MOST))
            del self._items[:dropped]
            self._changed.notify_all()
            return dropped

    def take(self) -> tuple[Item, int] | None:
        """Wait for an item; it and how many before it are dropped. None once closed."""
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

    def look_again(self) -> None:
        """Something came that items may have waited for."""
        with self._changed:
            self._changed.notify_all()

    def close(self) -> None:
        """Let everybody who waits go."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _left(self, k: int) -> float:
        item, came = self._items[k]
        return self._delay(item, time.monotonic() - came)
