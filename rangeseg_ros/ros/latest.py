"""Mailboxes of one slot between threads."""

from __future__ import annotations

from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar('Item')


class _Slot(Generic[Item]):
    def __init__(self) -> None:
        self._changed = Condition()
        self._item: Item | None = None
        self._closed = False

    def take(self) -> Item | None:
        """Wait for an item and take it; None once closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._item is not None)
            item, self._item = self._item, None
            self._changed.notify_all()
            return None if self._closed else item

    def close(self) -> None:
        """Let everybody who waits go."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Latest(_Slot[Item]):
    """Holds the newest item only: the latest frame wins, nothing queues up."""

    def put(self, item: Item) -> bool:
        """Leave `item` for the taker; True when it replaced one that nobody had taken."""
        with self._changed:
            replaced = self._item is not None
            self._item = item
            self._changed.notify_all()
            return replaced


class HandOver(_Slot[Item]):
    """Holds one item, and whoever brings another waits: nothing is lost."""

    def put(self, item: Item) -> None:
        """Leave `item` for the taker, once the one before was taken."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._item is None)
            self._item = item
            self._changed.notify_all()
