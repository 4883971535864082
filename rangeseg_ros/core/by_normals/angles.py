"""Data cost of method normals: the angle between a normal and a direction (thesis eq. 5.5).

Two arc cosines, each where it is quickest: NumPy's over whole images, a polynomial in kernels.
"""

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

    def __call__(
        self, label: int, pixels: NDArray[np.integer] | None = None
    ) -> NDArray[np.float32]:
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
