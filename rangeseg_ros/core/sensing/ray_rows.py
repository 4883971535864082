"""The ray of a pixel, for kernels that look at many rows here and there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, inline='always')
def ray_of(rays: NDArray[np.float32], pinhole: bool, i: int, j: int) -> tuple[Any, Any, Any]:
    """Ray of a pixel.

    Of a pinhole camera x is the same in all rows and y in all columns: two rows' worth of numbers
    stay in cache then, and the rest of an image of rays is not read.
    """
    row, column = (0, 0) if pinhole else (i, j)
    return rays[row, j, 0], rays[i, column, 1], rays[row, j, 2]
