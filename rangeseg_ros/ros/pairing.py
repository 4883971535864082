"""Which camera_info belongs to an image."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, NamedTuple

KEPT = 10
"""Camera infos to look among: as many as the queues of image and camera_info may lie apart."""


class Found(NamedTuple):
    """What to use for an image, and whether it carries the stamp of the image."""

    item: Any
    exact: bool


class StampPairing:
    """Pairs by stamp where both carry one; the last otherwise, as some cameras send one only.

    Which of both a camera does is learned from what it sends: once a pair of equal stamps was
    seen, an image waits for its own (`by_stamp`), until the next image shows that there will be
    none.
    """

    def __init__(self) -> None:
        self.by_stamp = False
        self._items: OrderedDict[int, Any] = OrderedDict()
        self._last: Any = None
        self._asked = 0

    def add(self, stamp: int, item: Any) -> None:
        """Take an item; `stamp` in nanoseconds, 0 = none."""
        self._last = item
        if not stamp:
            return
        self._items[stamp] = item
        if len(self._items) > KEPT:
            self._items.popitem(last=False)
        # It came after its image, for which nobody knew that it had to wait.
        self.by_stamp |= stamp == self._asked

    def find(self, stamp: int) -> Found | None:
        """The item for an image; None while it has to wait."""
        self._asked = stamp
        if stamp in self._items:
            self.by_stamp = True
            return Found(self._items[stamp], True)
        if self._last is None or (stamp and self.by_stamp):
            return None
        return Found(self._last, False)

    def give_up(self) -> None:
        """Do not wait: the next image is there and the item of the one before is not."""
        self.by_stamp = False
