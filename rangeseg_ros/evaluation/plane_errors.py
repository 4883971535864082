"""Errors of the planes of regions that were found, and of the angles between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray


def angle_errors(
    angles: Iterable[tuple[int, int, float]],
    normals: Mapping[int, ArrayLike],
    matches: Mapping[int, int],
) -> NDArray[np.float64]:
    """Errors of the angles between regions, over the pairs whose regions are both correct.

    Parameters
    ----------
    angles : iterable of (label, label, degrees)
        Angles between regions of the truth, as in a `.gt-ang` file.
    normals : mapping of label to (3,) float
        Normals of the segmentation's regions.
    matches : mapping
        `Classification.matches`.

    Returns
    -------
    (N,) float64
        Absolute differences in degrees, the angles folded to 0..90.
    """
    errors = []
    for first, second, degrees in angles:
        if first in matches and second in matches:
            a, b = (np.asarray(normals[matches[label]], float) for label in (first, second))
            # atan2 of sine and cosine: the arc cosine alone loses precision near 0.
            found = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))
            errors.append(abs(min(degrees, 180.0 - degrees) - found))
    return np.array(errors)


def plane_errors(
    truth: Mapping[int, ArrayLike], found: Mapping[int, ArrayLike], matches: Mapping[int, int]
) -> NDArray[np.float64]:
    """Errors of the planes of correct regions.

    Parameters
    ----------
    truth, found : mapping of label to (4,) float
        Planes (nx, ny, nz, d) with n . p + d = 0, n of unit length; the sign is immaterial.
    matches : mapping
        `Classification.matches`.

    Returns
    -------
    (N, 2) float64
        Angle between the normals in degrees, and difference of the distances from the origin
        in metres, in the order of `matches`; regions whose plane is not known are left out.
    """
    errors = []
    for label, partner in matches.items():
        if label not in truth or partner not in found:
            continue
        a, b = np.asarray(truth[label], float), np.asarray(found[partner], float)
        if a[:3] @ b[:3] < 0:
            b = -b
        angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a[:3], b[:3])), a[:3] @ b[:3]))
        errors.append((angle, abs(a[3] - b[3])))
    return np.array(errors).reshape(-1, 2)
