"""Blocks inside regions: what is asked of their pixels, the sums over the blocks tell."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.marks import find_marked

RIM = 2
"""Pixels from another region up to which a pixel may be its neighbour's."""


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


def interior(labels: NDArray[np.uint16], filled: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Region of each block that it fills together with two pixels on all sides.

    Parameters
    ----------
    labels : (H, W) uint16
        0...M.
    filled : (rows, columns) uint16
        See `fill`.

    Returns
    -------
    (rows, columns) uint16
        0 for the others, and for all at the border of the image.
    """
    inner = np.zeros_like(filled)
    run_rows(_leave_borders, len(filled), labels, filled, inner)
    return inner


@njit(cache=True, nogil=True)
def _leave_borders(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    filled: NDArray[np.uint16],
    inner: NDArray[np.uint16],
) -> None:
    """The same of some rows of blocks."""
    for bi in range(max(first, 1), min(after, len(filled) - 1)):
        for bj in range(1, filled.shape[1] - 1):
            label = filled[bi, bj]
            if label == 0:
                continue
            alike = True
            for k in range(bi - 1, bi + 2):
                for m in range(bj - 1, bj + 2):
                    alike &= filled[k, m] == label
            if not alike:
                unlike = label ^ label
                # Whole rows: the block itself is known to be alike.
                for i in range(bi * BLOCK - RIM, min((bi + 1) * BLOCK + RIM, len(labels))):
                    for j in range(bj * BLOCK - RIM, min((bj + 1) * BLOCK + RIM, labels.shape[1])):
                        unlike |= labels[i, j] ^ label
                    if unlike:
                        break
                alike = unlike == 0
            if alike:
                inner[bi, bj] = label


@njit(cache=True, inline='always')
def rows_of_blocks(first: int, after: int) -> tuple[int, int]:
    """Rows of blocks that begin in some rows of pixels."""
    return -(-first // BLOCK), -(-after // BLOCK)


@njit(cache=True, nogil=True)
def find_loose(
    labels: NDArray[np.uint16],
    filled: NDArray[np.uint16],
    marks: NDArray[np.uint8],
    places: NDArray[np.intp],
) -> int:
    """Pixels of regions in a row, but for those of blocks that a region fills.

    Parameters
    ----------
    labels : (W,) uint16
        Of the row.
    filled : (ceil(W / 4),) uint16
        Of its row of blocks, see `fill`.
    marks : (m,) uint8
        Of the row, see `no_marks`.
    places : (m,) int
        Receives the columns of the pixels.

    Returns
    -------
    int
        How many they are.
    """
    for j in range(len(labels)):
        marks[j] = labels[j] > 0
    # Each word tells of a block.
    four = marks.view(np.uint32)
    for bj in range(len(filled)):
        four[bj] = four[bj] if filled[bj] == 0 else 0
    return find_marked(marks, 0, places)
