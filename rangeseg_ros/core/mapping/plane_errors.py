"""What planes err by, as three numbers: planes have three degrees of freedom.

A plane is its unit normal n and a point p on it. Its error is x = (a, b, c): the true normal is
n + a e1 + b e2 with the axes e1, e2 of the tangent space of the unit sphere at n, and the true
plane passes c below p along n. No covariance of x is singular, as that of (normal, distance) is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.rotations import cross_products


def tangents(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors across each unit normal (N, 3), right-handed with it: (N, 2, 3).

    Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    x, y, z = normal.T
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    axes = np.empty((len(normal), 2, 3))
    axes[:, 0, 0], axes[:, 0, 1], axes[:, 0, 2] = 1 + sign * x * x * a, sign * b, -sign * x
    axes[:, 1, 0], axes[:, 1, 1], axes[:, 1, 2] = b, sign + y * y * a, -y
    return axes


def to_errors(axes: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3, 4) from (normal, distance) to (a, b, c) of planes with `axes` (K, 2, 3)."""
    local = np.zeros((len(axes), 3, 4))
    local[:, :2, :3] = axes
    local[:, 2, :3] = point
    local[:, 2, 3] = 1
    return local


def from_errors(axes: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 4, 3) from (a, b, c) to (normal, distance)."""
    jacobian = np.zeros((len(axes), 4, 3))
    jacobian[:, :3, :2] = axes.transpose(0, 2, 1)
    jacobian[:, 3, :2] = -(axes @ point[:, :, None])[..., 0]
    jacobian[:, 3, 2] = 1
    return jacobian


def shifted(
    normal: NDArray[np.float64],
    point: NDArray[np.float64],
    axes: NDArray[np.float64],
    step: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Normals, points and axes of planes without the errors `step` (K, 3).

    The axes turn with their plane.
    """
    first, second = axes[:, 0], axes[:, 1]
    normal = normal + step[:, :1] * first + step[:, 1:2] * second
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = first - (first * normal).sum(axis=1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, cross_products(normal, first)], axis=1)
    return normal, point - step[:, 2:] * normal, axes


def cross_matrices(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3, 3) matrices of cross products: cross_matrices(a) @ b = a x b."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
