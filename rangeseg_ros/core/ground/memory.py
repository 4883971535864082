"""How high the camera is above the ground, remembered while the ground is out of view.

Without a stated height, each image tells it by itself: the surface that reaches nearest to below
the camera. Where a table or a wall hides the floor that is something else, and a robot does not
change its level from one image to the next.
"""

from __future__ import annotations

from collections.abc import Callable

from rangeseg_ros.core.ground.terrain import Terrain


class HeightMemory:
    """Height of one camera above the ground.

    Parameters
    ----------
    patience : float
        Seconds for which it holds while the ground is out of view.
    """

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self.forget()

    def forget(self) -> None:
        """Know nothing."""
        self._height = 0.0
        self._stamp = 0

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
        if stamp - self._stamp > 1e9 * self.patience:
            self.forget()
        found = find((self._height, doubt) if self._height else (0.0, 0.0))
        if found.stand.surface:
            self._height, self._stamp = found.stand.height(found.field.up), stamp
            return found
        return found._replace(remembered=self._height)
