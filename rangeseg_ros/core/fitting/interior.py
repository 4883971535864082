"""Blocks inside regions: what is asked of their pixels, the sums over the blocks tell."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import BLOCK


def fill(labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Region of each block of 4 x 4 pixels that has one label.

    Parameters
    ----------
    labels : (H, W) uint16
        0...M.

    Returns
    -------
    (ceil(H / 4), ceil(W / 4)) uint16
        0 for the others, and for those that the border of the image cuts.
    """
    height, width = labels.shape
    filled = np.zeros((-(-height // BLOCK), -(-width // BLOCK)), np.uint16)
    run_rows(_fill, height // BLOCK, labels, filled)
    return filled


@njit(cache=True, nogil=True)
def _fill(first: int, after: int, labels: NDArray[np.uint16], filled: NDArray[np.uint16]) -> None:
    """The same of some rows of blocks."""
    for bi in range(first, after):
        top = bi * BLOCK
        for bj in range(labels.shape[1] // BLOCK):
            left = bj * BLOCK
            label = labels[top, left]
            # Without branches, so that the compiler takes many at a time.
            unlike = label ^ label
            for i in range(top, top + BLOCK):
                for j in range(left, left + BLOCK):
                    unlike |= labels[i, j] ^ label
            if unlike == 0:
                filled[bi, bj] = label


@njit(cache=True)
def interior(filled: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Region of each block that it fills together with the eight blocks around it.

    Parameters
    ----------
    filled : (rows, columns) uint16
        See `fill`.

    Returns
    -------
    (rows, columns) uint16
        0 for the others, and for all at the border of the image.
    """
    inner = np.zeros_like(filled)
    for i in range(1, len(filled) - 1):
        for j in range(1, filled.shape[1] - 1):
            label = filled[i, j]
            if label == 0:
                continue
            alike = True
            for k in range(i - 1, i + 2):
                for m in range(j - 1, j + 2):
                    alike &= filled[k, m] == label
            if alike:
                inner[i, j] = label
    return inner


@njit(cache=True, inline='always')
def rows_of_blocks(first: int, after: int) -> tuple[int, int]:
    """Rows of blocks that begin in some rows of pixels."""
    return -(-first // BLOCK), -(-after // BLOCK)
