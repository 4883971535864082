"""Data cost and Potts prior: the energy of a labelling (thesis eq. 5.3)."""

from __future__ import annotations

import numpy as np
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
