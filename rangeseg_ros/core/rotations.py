"""Rotation matrices and unit quaternions x, y, z, w.

The few forms that the core needs: to import SciPy's takes longer than to segment a frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rangeseg_ros.core.arrays import Floats


def quaternions(rotations: Floats) -> Floats:
    """Unit quaternions (..., 4) x, y, z, w, with w >= 0, of rotations (..., 3, 3).

    A rotation has all products of two components of its quaternion q: they make up 4 q q^T, of
    which the row with the largest diagonal is q itself but for its length (Shepperd, Quaternion
    from rotation matrix, Journal of Guidance and Control 1978).
    """
    xx, yy, zz = (rotations[..., k, k] for k in range(3))
    products = np.empty((*rotations.shape[:-2], 4, 4))
    for k, own in enumerate((xx, yy, zz)):
        after, last = (k + 1) % 3, (k + 2) % 3
        products[..., k, k] = 1 + 2 * own - (xx + yy + zz)
        one, other = rotations[..., after, k], rotations[..., k, after]
        products[..., k, after] = products[..., after, k] = one + other
        one, other = rotations[..., last, after], rotations[..., after, last]
        products[..., k, 3] = products[..., 3, k] = one - other
    products[..., 3, 3] = 1 + xx + yy + zz
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    row /= np.linalg.norm(row, axis=-1, keepdims=True)
    signed: Floats = row * np.where(row[..., 3:] < 0, -1.0, 1.0)
    return signed


def rotation_matrix(quaternion: ArrayLike) -> Floats:
    """Rotation (3, 3) of a unit quaternion x, y, z, w."""
    x, y, z, w = np.asarray(quaternion, np.float64)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_by(turn: ArrayLike) -> Floats:
    """Rotation (3, 3) about the vector `turn` (3,) by its length, radians (Rodrigues)."""
    x, y, z = np.asarray(turn, np.float64)
    angle = np.sqrt(x * x + y * y + z * z)
    cross = cross_matrix(turn)
    # sin(a) / a and (1 - cos(a)) / a^2, right for the smallest angles as well.
    first = np.sinc(angle / np.pi)
    second = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    rotation: Floats = np.eye(3) + first * cross + second * (cross @ cross)
    return rotation


def turn_between(first: Floats, second: Floats) -> Floats:
    """The least rotation (3, 3) that takes a unit vector (3,) to another one, not its opposite."""
    cross = cross_matrix(np.cross(first, second))
    return np.eye(3) + cross + cross @ cross / (1 + first @ second)


def cross_matrix(vector: ArrayLike) -> Floats:
    """Matrix (3, 3) of cross products: cross_matrix(a) @ b = a x b."""
    x, y, z = np.asarray(vector, np.float64)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
