"""Data cost and Potts prior: the energy of a labelling (thesis eq. 5.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def angle(first: NDArray[np.floating], second: NDArray[np.floating]) -> NDArray[np.floating]:
    """Angle between unit vectors (..., 3) in degrees, thesis eq. 5.5; 0 where either is NaN."""
    cosine = np.einsum('...k,...k', first, second)
    return np.nan_to_num(np.degrees(np.arccos(np.clip(cosine, -1, 1))), copy=False, nan=0.0)


def angular_cost(
    normals: NDArray[np.float32], directions: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Angle between observed normals and the labels' directions (thesis eq. 5.5).

    Parameters
    ----------
    normals : (..., 3) float32
        Unit vectors, NaN where none is defined.
    directions : (K, 3) float
        Unit vectors.

    Returns
    -------
    (K, ...) float32
        Degrees; 0 where no normal is defined, so that the neighbours decide (thesis 6.7).
    """
    flat = normals.reshape(-1, 3)
    cost = directions.astype(np.float32) @ flat.T
    np.clip(cost, -1, 1, out=cost)
    np.arccos(cost, out=cost)
    cost *= np.float32(180 / np.pi)
    cost[:, np.isnan(flat[:, 0])] = 0
    return cost.reshape(len(directions), *normals.shape[:-1])


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
