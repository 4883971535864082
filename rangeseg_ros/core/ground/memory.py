"""How high the camera is above the ground, remembered while the ground is out of view.

Without a stated height, each image tells it by itself: the surface that reaches nearest to below
the camera. Where a table or a wall hides the floor that is something else, and a robot does not
change its level from one image to the next.
"""

from __future__ import annotations

from collections.abc import Callable

from rangeseg_ros.core.ground.terrain import Terrain

# Share of the newest image in what is remembered.
_NEWEST = 0.2


class HeightMemory:
    """Height of one camera above the ground.

    Parameters
    ----------
    patience : float
        Seconds for which a surface farther below, with none at the remembered height in view,
        must be seen to be the ground. A surface less far below, such as a table, never is.
    """

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self.forget()

    def forget(self) -> None:
        """Know nothing."""
        self._height = 0.0
        self._doubted: int | None = None

    def terrain(
        self, find: Callable[[tuple[float, float]], Terrain], doubt: float, stamp: int
    ) -> Terrain:
        """Terrain of the next image, found with what is remembered, which it then adds to.

        Parameters
        ----------
        find : callable
            Finds it: gets the height of the camera and its standard deviation, metres; 0, 0 when
            nothing is known.
        doubt : float
            How well the height is remembered, metres.
        stamp : int
            Of the image, nanoseconds.
        """
        if not self._height:
            return self._remembered(find((0.0, 0.0)))
        found = find((self._height, doubt))
        if found.stand.surface:
            return self._remembered(found)
        other = find((0.0, 0.0))
        deeper = other.stand.height(other.field.up) > self._height + 2 * doubt
        if not deeper:
            self._doubted = None
        elif self._doubted is None:
            self._doubted = stamp
        elif stamp - self._doubted > 1e9 * self.patience:
            self.forget()
            return self._remembered(other)
        return found._replace(remembered=self._height)

    def _remembered(self, found: Terrain) -> Terrain:
        if found.stand.surface:
            height = found.stand.height(found.field.up)
            share = _NEWEST if self._height else 1.0
            self._height += share * (height - self._height)
            self._doubted = None
        return found
