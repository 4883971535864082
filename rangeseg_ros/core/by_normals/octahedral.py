"""Data costs of directions by the cell that a normal lies in: a table instead of arc cosines."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

# Cells of the octahedral map (Meyer et al., "On floating-point normal vectors", EGSR 2010) along
# each axis: normals of a cell count as its centre, within two degrees.
_CELLS = 128
# Degrees in a unit of the data costs: 180 degrees at every pixel of a tile fit in 16 bits.
UNIT = np.float32(0.25)


@lru_cache(maxsize=4)
def angle_table(directions: bytes, count: int) -> tuple[NDArray[np.uint16], NDArray[np.int32]]:
    """Angles (cells, count) of the centres of the cells to directions; the nearest direction."""
    middle = (np.arange(_CELLS) + 0.5) * (2 / _CELLS) - 1
    u, v = (a.ravel() for a in np.meshgrid(middle, middle, indexing='ij'))
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    centres = np.stack([u - np.copysign(fold, u), v - np.copysign(fold, v), z], 1)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    vectors = np.frombuffer(directions, np.float32).reshape(count, 3)
    angles = np.degrees(np.arccos(np.clip(centres @ vectors.T, -1, 1)))
    return np.rint(angles / UNIT).astype(np.uint16), angles.argmin(axis=1).astype(np.int32)


@njit(cache=True, nogil=True)
def cell_of(x: np.float32, y: np.float32, z: np.float32) -> int:
    """Cell of the octahedral map that a direction lies in, -1 for none."""
    length = abs(x) + abs(y) + abs(z)
    if not length > 0:
        return -1
    u, v = x / length, y / length
    if z < 0:
        u, v = (
            np.float32(math.copysign(np.float32(1) - abs(v), u)),
            np.float32(math.copysign(np.float32(1) - abs(u), v)),
        )
    a = min(max(int((u + np.float32(1)) * np.float32(_CELLS / 2)), 0), _CELLS - 1)
    b = min(max(int((v + np.float32(1)) * np.float32(_CELLS / 2)), 0), _CELLS - 1)
    return a * _CELLS + b


@njit(cache=True, nogil=True)
def find_cells(
    first: int, after: int, normals: NDArray[np.float32], result: NDArray[np.int32]
) -> None:
    """Cell that each normal of some rows lies in, -1 for NaN."""
    for i in range(first, after):
        for j in range(result.shape[1]):
            result[i, j] = cell_of(normals[i, j, 0], normals[i, j, 1], normals[i, j, 2])
