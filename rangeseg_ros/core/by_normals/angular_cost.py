"""Data cost of method normals: the angle between a normal and a direction (thesis eq. 5.5).

A site is a square of `size` x `size` pixels, numbered in raster order, and costs the sum of the
angles of its pixels, in degrees. A pixel without normal (NaN) costs nothing, so that its
neighbours decide (thesis 6.7).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def data_costs(
    labels: NDArray[np.int32],
    size: int,
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Cost (h, w) of every site's own label, of normals (H, W, 3) and directions (K, 3)."""
    costs = np.empty(labels.shape, np.float32)
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            costs[i, j] = _cost(directions[labels[i, j]], i, j, size, normals)
    return costs


@njit(cache=True, nogil=True)
def label_costs(
    label: int,
    sites: NDArray[np.integer],
    size: int,
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Cost (s,) of one label at sites (s,); the rest as of `data_costs`."""
    width = -(-normals.shape[1] // size)
    costs = np.empty(len(sites), np.float32)
    for s in range(len(sites)):
        row, column = sites[s] // width, sites[s] % width
        costs[s] = _cost(directions[label], row, column, size, normals)
    return costs


@njit(cache=True, inline='always')
def _cost(
    direction: NDArray[np.float32], row: int, column: int, size: int, normals: NDArray[np.float32]
) -> np.float32:
    height, width = normals.shape[:2]
    a, b, c = direction
    total = np.float32(0)
    for i in range(row * size, min((row + 1) * size, height)):
        for j in range(column * size, min((column + 1) * size, width)):
            normal = normals[i, j]
            total += degrees(a * normal[0] + b * normal[1] + c * normal[2])
    return total


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
