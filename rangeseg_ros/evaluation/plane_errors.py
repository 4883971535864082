"""Errors of the planes of regions that were found, and of the angles between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.arrays import Floats


def angle_errors(
    angles: Iterable[tuple[int, int, float]],
    normals: Mapping[int, ArrayLike],
    matches: Mapping[int, int],
) -> Floats:
    """Errors (N,) of the angles between regions, degrees, where both regions are correct.

    `angles` are (label, label, degrees) of the truth, `normals` (3,) those of the segmentation's
    regions, `matches` those of a `Classification`. Angles are folded to 0..90.
    """
    errors = []
    for first, second, degrees in angles:
        if {matches.get(first), matches.get(second)} <= normals.keys():
            found = _angle(*(np.asarray(normals[matches[label]]) for label in (first, second)))
            errors.append(abs(min(degrees, 180.0 - degrees) - min(found, 180.0 - found)))
    return np.array(errors)


def plane_errors(
    truth: Mapping[int, ArrayLike], found: Mapping[int, ArrayLike], matches: Mapping[int, int]
) -> Floats:
    """Errors (N, 2) of the planes of correct regions, in the order of `matches`.

    Angle between the normals in degrees, and difference of the distances from the origin in
    metres. Planes are (nx, ny, nz, d) with n . p + d = 0, n of unit length; the sign is
    immaterial. Regions whose plane is not known are left out.
    """
    errors = []
    for label, partner in matches.items():
        if label in truth and partner in found:
            a, b = np.asarray(truth[label], float), np.asarray(found[partner], float)
            if a[:3] @ b[:3] < 0:
                b = -b
            errors.append((_angle(a[:3], b[:3]), abs(a[3] - b[3])))
    return np.array(errors).reshape(-1, 2)


def _angle(a: NDArray, b: NDArray) -> float:
    """Angle between two vectors, degrees: the arc cosine alone loses precision near 0."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
