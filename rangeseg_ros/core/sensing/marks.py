"""Where a row is marked: most is not, and no processor foretells the rest."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def no_marks(width: int) -> NDArray[np.uint8]:
    """Marks (m,) of a row so wide: zeros, m the next multiple of eight."""
    return np.zeros((width + 7) // 8 * 8, np.uint8)


@njit(cache=True, nogil=True)
def find_marked(marks: NDArray[np.uint8], first: int, places: NDArray[np.integer]) -> int:
    """Numbers of the marks that are 1, counted from `first`, to `places` (m,); how many they are.

    Parameters
    ----------
    marks : (m,) uint8
        0 or 1, see `no_marks`.
    first : int
    places : (m,) int
    """
    eight = marks.view(np.uint64)
    count = 0
    for k in range(len(eight)):
        if eight[k] != 0:
            # Without branches.
            for j in range(8 * k, 8 * k + 8):
                places[count] = first + j
                count += int(marks[j])
    return count
