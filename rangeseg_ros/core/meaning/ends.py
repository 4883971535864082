"""Where the ground ends in columns of cells: feet of what stands there, and how it ends in all."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.classes import GROUND


@njit(cache=True, nogil=True)
def ends_of(
    said: NDArray[np.int8], height: NDArray[np.float32], least: float, turned: bool
) -> tuple[int, int]:
    """Columns in which something stands where the ground ends, and in which it falls off."""
    rows, columns = height.shape
    stands = falls = 0
    for c in range(columns):
        beyond = 0
        for m in range(rows):  # towards the robot
            i = rows - 1 - m if turned else m
            if said[i, c] == GROUND and abs(height[i, c]) <= least:
                stands += beyond > 0
                falls += beyond < 0
                break
            if abs(height[i, c]) > least:
                beyond = 1 if height[i, c] > 0 else -1
    return stands, falls


@njit(cache=True, nogil=True)
def feet_of(
    height: NDArray[np.float32],
    steep: NDArray[np.bool_],
    error: NDArray[np.float32],
    rise: tuple[float, float],
    least: float,
    turned: bool,
) -> NDArray[np.bool_]:
    """Cells of a steep surface that rises to an obstacle above them in the image.

    By more than `rise`: so many times their `error`, and metres.
    """
    rows, columns = height.shape
    chance, fewest = np.float32(rise[0]), np.float32(rise[1])
    foot = np.zeros((rows, columns), np.bool_)
    above = np.zeros(columns, np.bool_)
    for m in range(rows):
        i = rows - 1 - m if turned else m
        for c in range(columns):
            if np.isnan(height[i, c]):
                continue
            if height[i, c] > least:
                above[c] = True
            elif above[c] and steep[i, c] and height[i, c] > max(chance * error[i, c], fewest):
                foot[i, c] = True
            else:
                above[c] = False
    return foot
