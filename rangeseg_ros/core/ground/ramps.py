"""Ramps: how steep they are, and which way they climb."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane


class Ramp(NamedTuple):
    """A plane with the role `ramp`.

    Attributes
    ----------
    plane : int
        Its id.
    slope : float
        Between it and level, degrees.
    centre : (3,) float64
        Centroid of the plane, metres, in the frame of the image.
    climb : (3,) float64
        Unit vector along the plane, in the direction that climbs most steeply.
    """

    plane: int
    slope: float
    centre: NDArray[np.float64]
    climb: NDArray[np.float64]

    def __str__(self) -> str:
        """Its slope."""
        return f'ramp {self.slope:.0f} degrees'


def ramps_of(planes: Sequence[Plane], up: NDArray[np.float64]) -> list[Ramp]:
    """The ramps among planes with roles; `up` (3,) is a unit vector in their frame."""
    found = []
    for plane in planes:
        if plane.role != 'ramp':
            continue
        rise = float(plane.normal @ up)
        along = up - rise * plane.normal
        length = float(np.linalg.norm(along))  # the sine of the slope
        slope = float(np.degrees(np.arctan2(length, rise)))
        found.append(Ramp(plane.id, slope, plane.centroid, along / length))
    return found
