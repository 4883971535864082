"""Rays of an image row by row, each coordinate by itself, as vector instructions take them.

Those of a pinhole camera are the same in every row but for y: nothing but a number is read.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, inline='always')
def ray_of(rays: NDArray[np.float32], pinhole: bool, i: int, j: int) -> tuple[Any, Any, Any]:
    """Ray of a pixel: where many rows are looked at here and there, of `pinhole` see `next_rays`.

    Two rows' worth of numbers stay in cache then, and the rest of an image of rays is not read.
    """
    row, column = (0, 0) if pinhole else (i, j)
    return rays[row, j, 0], rays[i, column, 1], rays[row, j, 2]


@njit(cache=True, inline='always')
def first_rays(rays: NDArray[np.float32], v: int) -> NDArray[np.float32]:
    """Rays of row v, (3, W)."""
    row = np.empty((3, rays.shape[1]), np.float32)
    next_rays(rays, False, v, row)
    return row


@njit(cache=True, inline='always')
def next_rays(rays: NDArray[np.float32], pinhole: bool, v: int, row: NDArray[np.float32]) -> None:
    """Make rays of row v of those of another one.

    Parameters
    ----------
    rays : (H, W, 3) float32
    pinhole : bool
        Whether x and z are the same in all rows, and y in each of them.
    v : int
    row : (3, W) float32
        Of any row, changed.
    """
    if pinhole:
        y = rays[v, 0, 1]
        for j in range(row.shape[1]):
            row[1, j] = y
        return
    for k in range(3):
        for j in range(row.shape[1]):
            row[k, j] = rays[v, j, k]
