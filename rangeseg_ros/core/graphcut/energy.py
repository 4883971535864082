"""Data cost and Potts prior: the energy of a labelling (thesis eq. 5.3)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def angle(normals: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Angle in degrees between unit vectors (3, ...), 0 where undefined (thesis eq. 5.5)."""
    x, y, z = normals
    a, b, c = directions
    cosine = x * a
    cosine += y * b
    cosine += z * c
    # fmin turns NaN into 1, an angle of 0.
    np.fmin(cosine, 1, out=cosine)
    np.maximum(cosine, -1, out=cosine)
    return np.degrees(np.arccos(cosine, out=cosine), out=cosine)


class AngularCost:
    """Angle between observed normals and the labels' directions (thesis eq. 5.5).

    Parameters
    ----------
    normals : (..., 3) float32
        Unit vectors, NaN where none is defined.
    directions : (K, 3) float
        Unit vectors.

    Attributes
    ----------
    count : int
        Number of labels.
    """

    def __init__(self, normals: NDArray[np.float32], directions: NDArray[np.floating]) -> None:
        # One plane per component, over which NumPy runs many times faster than over triples.
        self._normals = np.ascontiguousarray(normals.reshape(-1, 3).T)
        self._directions = directions.astype(np.float32)
        self.count = len(directions)

    def __call__(self, label: int, pixels: NDArray[np.intp] | None = None) -> NDArray[np.float32]:
        """Degrees at pixels (n,) given by their index in raster order, all pixels by default.

        0 where no normal is defined, so that the neighbours decide (thesis 6.7).
        """
        normals = self._normals if pixels is None else self._normals.take(pixels, axis=1)
        return angle(normals, self._directions[label])

    def nearest(self) -> NDArray[np.intp]:
        """Label of the least cost at every pixel, (N,)."""
        best = np.zeros(self._normals.shape[1], np.intp)
        least = self(0)
        for label in range(1, self.count):
            cost = self(label)
            better = cost < least
            best[better] = label
            np.minimum(cost, least, out=least)
        return best


@njit(cache=True, inline='always')
def degrees(cosine: np.float32) -> np.float32:
    """Arc cosine in degrees, 0 for NaN; Abramowitz and Stegun 4.4.46, to 2e-8 rad.

    Without branches and calls, so that the compiler can make eight at a time.
    """
    x = min(abs(cosine), np.float32(1))
    p = np.float32(-0.0012624911)
    p = p * x + np.float32(0.0066700901)
    p = p * x + np.float32(-0.0170881256)
    p = p * x + np.float32(0.0308918810)
    p = p * x + np.float32(-0.0501743046)
    p = p * x + np.float32(0.0889789874)
    p = p * x + np.float32(-0.2145988016)
    p = p * x + np.float32(1.5707963050)
    p = p * np.sqrt(np.float32(1) - x) * np.float32(180 / np.pi)
    p = p if cosine >= 0 else np.float32(180) - p
    return p if cosine == cosine else np.float32(0)


@njit(cache=True, fastmath={'reassoc'})
def site_angle(normals: NDArray[np.float32], a: float, b: float, c: float) -> np.float32:
    """Angles of the direction (a, b, c) to the normals (3, m) of a site, degrees, summed."""
    total = np.float32(0)
    for k in range(normals.shape[1]):
        total += degrees(normals[0, k] * a + normals[1, k] * b + normals[2, k] * c)
    return total


@njit(cache=True)
def _to_degrees(cosine: NDArray[np.float32]) -> None:
    for k in range(len(cosine)):
        cosine[k] = degrees(cosine[k])


@njit(cache=True)
def angles(
    sites: NDArray[np.int32], normals: NDArray[np.float32], direction: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Angles of a direction to the normals at some sites, degrees, summed over each site.

    Parameters
    ----------
    sites : (s,) int32
    normals : (n, 3, m) float32
        Normals of the m pixels of each site, NaN where undefined, which counts 0.
    direction : (3,) float32

    Returns
    -------
    (s,) float32
    """
    m = normals.shape[2]
    a, b, c = direction[0], direction[1], direction[2]
    each = np.empty(len(sites) * m, np.float32)
    for s in range(len(sites)):
        p = sites[s]
        for k in range(m):
            each[s * m + k] = normals[p, 0, k] * a + normals[p, 1, k] * b + normals[p, 2, k] * c
    _to_degrees(each)
    return _summed(each, m)


@njit(cache=True)
def mixed_angles(
    labels: NDArray[np.int32], normals: NDArray[np.float32], directions: NDArray[np.float32]
) -> NDArray[np.float32]:
    """As `angles` at all sites (n,), each with the direction of its label."""
    m = normals.shape[2]
    each = np.empty(len(labels) * m, np.float32)
    for p in range(len(labels)):
        a, b, c = directions[labels[p], 0], directions[labels[p], 1], directions[labels[p], 2]
        for k in range(m):
            each[p * m + k] = normals[p, 0, k] * a + normals[p, 1, k] * b + normals[p, 2, k] * c
    _to_degrees(each)
    return _summed(each, m)


@njit(cache=True, fastmath={'reassoc'})
def _summed(each: NDArray[np.float32], m: int) -> NDArray[np.float32]:
    if m == 1:
        return each
    total = np.empty(len(each) // m, np.float32)
    for s in range(len(total)):
        value = np.float32(0)
        for k in range(s * m, (s + 1) * m):
            value += each[k]
        total[s] = value
    return total


def energy(
    data: NDArray[np.floating],
    labels: NDArray[np.integer],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
) -> float:
    """Value of eq. 5.3 for a labelling of the 4-connected grid.

    Parameters
    ----------
    data : (H, W) float
        Data cost of each pixel's label.
    labels : (H, W) int
    horizontal, vertical : (H, W-1), (H-1, W) float
        Weights u of eq. 5.1 between a pixel and its right and lower neighbour.
    smoothness : float
        Lambda.
    """
    across = horizontal[labels[:, 1:] != labels[:, :-1]]
    down = vertical[labels[1:] != labels[:-1]]
    boundary = across.sum(dtype=float) + down.sum(dtype=float)
    return float(data.sum(dtype=float) + smoothness * boundary)
