"""Planes of regions: fit, parameters, uncertainty, outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Plane:
    """A planar region: normal . p + distance = 0 in metres, in the frame of the image.

    Attributes
    ----------
    label : int
        Value in the label image, 1...
    id : int
        Identity over time; the label when nothing is tracked.
    normal : (3,) float64
        Unit normal towards the sensor.
    distance : float
        Distance of the origin from the plane, metres, positive for a sensor at the origin.
    covariance : (4, 4) float64
        Covariance of (normal, distance).
    centroid : (3,) float64
        Mean of the region's points projected to the plane, metres.
    count : int
        Number of pixels.
    rms : float
        Root mean square distance of the region's points from the plane, metres.
    area : float
        Area of the region on the plane, square metres.
    hull : (N, 3) float64
        Outline of the region on the plane, metres, counter-clockwise seen from the sensor.
    """

    label: int
    id: int
    normal: NDArray[np.float64]
    distance: float
    covariance: NDArray[np.float64]
    centroid: NDArray[np.float64]
    count: int
    rms: float
    area: float
    hull: NDArray[np.float64]
