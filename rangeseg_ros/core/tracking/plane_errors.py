"""What planes err by, as three numbers, and the gate by which two planes may be one.

A plane is its unit normal n and a point p on it. Its error is x = (a, b, c): the true normal is
n + a e1 + b e2 with the axes e1, e2 of the tangent space of the unit sphere at n, and the true
plane passes c below p along n. No covariance of x is singular, as that of (normal, distance) is.
"""

from __future__ import annotations

import numpy as np

from rangeseg_ros.core.arrays import Floats, Mask
from rangeseg_ros.core.significance import chi2_quantile

# Chi-squared, with the three degrees of freedom of a plane, up to which two planes may be one.
GATE = chi2_quantile(3)
# Differences of planes of one surface between frames, beyond their covariances, as their pixels
# differ. OFFSET: share of the range (at 2 m half of a Kinect's distortion). ANGLE: the least one;
# the offset over half of the plane's width is added to it.
OFFSET, ANGLE = 0.007, np.radians(1.0)
# Half the width that a plane counts with at least, metres, so that what it tilts by is finite.
NARROWEST = 0.01
# Largest angle, and offset as share of the range, between one plane and itself in the next frame.
# Larger ones are no errors of the sensor, however uncertain both planes are.
LARGEST_TURN, LARGEST_OFFSET = np.radians(15.0), 0.1


def candidates(first: tuple[Floats, Floats], second: tuple[Floats, Floats], reach: Floats) -> Mask:
    """(N, M) which planes are near enough in angle and offset to be asked of the gate.

    Of the first, normals (N, 3) and distances (N,); of the second, normals and points (M, 3) on
    the planes, which are so far (M,) from the camera, metres.
    """
    near: Mask = first[0] @ second[0].T > np.cos(LARGEST_TURN)
    return near & (np.abs(first[0] @ second[1].T + first[1][:, None]) < LARGEST_OFFSET * reach)


def with_floor(spread: Floats, reach: Floats, width: Floats | float = np.inf) -> Floats:
    """Covariances (K, 3, 3) of differences, with what planes of one surface differ by anyway.

    Where both are looked at, so that c is independent of a and b, so far from the camera. `width`
    is half of that of the narrower plane; those of a map are not as narrow as one frame shows.
    """
    result = spread.copy()
    offset = (OFFSET * reach) ** 2
    result[:, 2, 2] += offset
    result[:, [0, 1], [0, 1]] += (ANGLE**2 + offset / width**2)[:, None]
    return result


def mahalanobis(gap: Floats, spread: Floats) -> Floats:
    """Squared Mahalanobis distances (K,) of `gap` (K, D) with covariances `spread` (K, D, D)."""
    value: Floats
    value = (gap * np.linalg.solve(spread, gap[..., None])[..., 0]).sum(axis=1)
    return value


def tangents(normal: Floats) -> Floats:
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


def to_errors(axes: Floats, point: Floats) -> Floats:
    """(K, 3, 4) from (normal, distance) to (a, b, c) of planes with `axes` (K, 2, 3)."""
    local = np.zeros((len(axes), 3, 4))
    local[:, :2, :3] = axes
    local[:, 2, :3] = point
    local[:, 2, 3] = 1
    return local


def from_errors(axes: Floats, point: Floats) -> Floats:
    """(K, 4, 3) from (a, b, c) to (normal, distance)."""
    jacobian = np.zeros((len(axes), 4, 3))
    jacobian[:, :3, :2] = axes.transpose(0, 2, 1)
    jacobian[:, 3, :2] = -(axes @ point[:, :, None])[..., 0]
    jacobian[:, 3, 2] = 1
    return jacobian


def shifted(
    normal: Floats, point: Floats, axes: Floats, step: Floats
) -> tuple[Floats, Floats, Floats]:
    """Normals, points and axes of planes without the errors `step` (K, 3).

    The axes turn with their plane.
    """
    first, second = axes[:, 0], axes[:, 1]
    normal = normal + step[:, :1] * first + step[:, 1:2] * second
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = first - (first * normal).sum(axis=1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first)], axis=1)
    return normal, point - step[:, 2:] * normal, axes


def by_motion(normal: Floats, axes: Floats, point: Floats) -> Floats:
    """(K, 3, 6) derivatives of (a, b, c) of planes seen, by a motion of the planes expected.

    The motion is a turn about the origin of `point`, radians, and a shift, metres.
    """
    design = np.zeros((len(normal), 3, 6))
    design[:, 0, :3], design[:, 1, :3] = -axes[:, 1], axes[:, 0]
    design[:, 2, :3] = np.cross(point, normal)
    design[:, 2, 3:] = normal
    return design


def congruent(by: Floats, covariance: Floats) -> Floats:
    """B C B^T of stacked matrices: the covariance of B x where C is that of x."""
    result: Floats = by @ covariance @ np.swapaxes(by, -1, -2)
    return result


def moved_plane(rotation: Floats, shift: Floats) -> Floats:
    """(4, 4) from (normal, distance) to those in a frame in which x is at rotation x + shift."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = rotation, -shift @ rotation
    return matrix
