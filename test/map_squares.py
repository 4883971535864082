"""Squares as planes of a map."""

import numpy as np

from rangeseg_ros.core.description.shapes import Shape
from rangeseg_ros.core.mapping.map_planes import MapOutline, MapPlane


def plane(number, normal, at, sigma, size=2.0):
    """A square of a plane around a point, whose direction is known to `sigma` radians."""
    normal = np.array(normal, float) / np.linalg.norm(normal)
    along = np.cross(normal, np.eye(3)[np.argmin(abs(normal))])
    along /= np.linalg.norm(along)
    axes = np.stack([along, np.cross(normal, along)])
    corners = at + size / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ axes
    jacobian = np.block([[axes.T, np.zeros((3, 1))], [-axes @ at, 1]])
    covariance = jacobian @ np.diag([sigma**2, sigma**2, 1e-6]) @ jacobian.T
    shape = Shape(size**2, np.array([size, size]), np.array(at), np.eye(3))
    return MapPlane(
        label=number,
        id=number,
        surface=number,
        normal=normal,
        distance=float(-normal @ at),
        covariance=covariance,
        centroid=np.array(at, float),
        count=1000,
        rms=0.002,
        probability=1.0,
        confidence=1.0,
        shape=shape,
        outline=MapOutline([[corners]]),
        observations=9,
        age=1.0,
        first_stamp=0,
        last_stamp=10**9,
    )
