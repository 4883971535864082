"""Square blocks of pixels: what tells the noise, and what surfaces are grown from."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.block_rows import (
    LANES,
    add_moments,
    add_row,
    block_plane,
    clear_sums,
    fit_sums,
    new_lanes,
    set_height,
    set_rays,
    store_sums,
)
from rangeseg_ros.core.sensing.moments import COUNT, SIZE
from rangeseg_ros.core.sensing.range_image import RangeImage

BLOCK = 4
"""Rows and columns of a block: the least that tells the noise from a plane through it, with 13
degrees of freedom; it finds faces 10 pixels wide."""


class Blocks(NamedTuple):
    """The blocks of an image and the planes through each.

    Attributes
    ----------
    moments : (rows, columns, 13) float64
        With unit weights, of the measured pixels.
    squared : (rows, columns) float64
        Mean square of the inverse range, 1/m^2.
    across, down : (rows, columns) float64
        Squares of the change of the inverse range from pixel to pixel on the plane, along the row
        and down the column, 1/m^2, less what noise adds to them.
    residual : (rows, columns) float64
        Sum of the squared residuals, 1/m^2.
    """

    moments: NDArray[np.float64]
    squared: NDArray[np.float64]
    across: NDArray[np.float64]
    down: NDArray[np.float64]
    residual: NDArray[np.float64]

    @classmethod
    def of(cls, image: RangeImage, size: int = BLOCK) -> Blocks:
        """Blocks of `size` pixels, 2 to 4."""
        height, width = image.shape
        blocks = cls._empty(-(-height // size), -(-width // size))
        rays = image.inverse, image.rays, image.pinhole
        run_rows(_sum_pixels, len(blocks.moments), *rays, size, blocks)
        return blocks

    def merged(self, rays: NDArray[np.float32], size: int) -> Blocks:
        """Every 2 x 2 of them as one: blocks of `size` pixels of these rays (H, W, 3)."""
        rows, columns = self.squared.shape
        blocks = self._empty((rows + 1) // 2, (columns + 1) // 2)
        run_rows(_sum_blocks, len(blocks.moments), self.moments, rays, size, blocks)
        return blocks

    @classmethod
    def _empty(cls, rows: int, columns: int) -> Blocks:
        """To be filled in, all of it: clearing it here would keep the other threads waiting."""
        moments = np.empty((rows, columns, SIZE))
        return cls(moments, *(np.empty((rows, columns)) for _ in range(4)))


@njit(cache=True, nogil=True)
def _sum_pixels(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    size: int,
    blocks: Blocks,
) -> None:
    """Fill in rows of blocks of pixels."""
    lanes = new_lanes()
    for begin in range(0, blocks.squared.shape[1], LANES):
        left = begin * size
        # Those that the rays of all rows of a pinhole camera share.
        for axis in (0, 2):
            set_rays(lanes, axis, rays[0, left:, axis], size)
        for bi in range(first, after):
            clear_sums(lanes)
            for i in range(bi * size, min((bi + 1) * size, len(inverse))):
                if pinhole:
                    set_height(lanes, rays[i, 0, 1])
                else:
                    for axis in range(3):
                        set_rays(lanes, axis, rays[i, left:, axis], size)
                add_row(lanes, inverse[i, left:], size)
            _store(bi, begin, lanes, rays, size, blocks)


@njit(cache=True, nogil=True)
def _sum_blocks(
    first: int,
    after: int,
    moments: NDArray[np.float64],
    rays: NDArray[np.float32],
    size: int,
    blocks: Blocks,
) -> None:
    """Fill in rows of blocks of 2 x 2 that have these moments."""
    lanes = new_lanes()
    for begin in range(0, blocks.squared.shape[1], LANES):
        for bi in range(first, after):
            clear_sums(lanes)
            for i in range(2 * bi, min(2 * bi + 2, len(moments))):
                add_moments(lanes, moments[i, 2 * begin :])
            _store(bi, begin, lanes, rays, size, blocks)


@njit(cache=True, nogil=True, error_model='numpy')
def _store(
    bi: int,
    begin: int,
    lanes: NDArray[np.float64],
    rays: NDArray[np.float32],
    size: int,
    blocks: Blocks,
) -> None:
    """Fill in as many blocks as there are lanes, or fewer at the border: sums, planes, slopes."""
    fit_sums(lanes)
    after = min(begin + LANES, blocks.squared.shape[1])
    squared, residual = blocks.squared[bi, begin:after], blocks.residual[bi, begin:after]
    store_sums(lanes, blocks.moments[bi, begin:after], squared, residual)
    # Variance of the slope in both directions together, of noise of unit variance.
    doubt = 2 * 12 / (size * size - 1)
    # The pixel in the middle of a block and its neighbours; the last block may be cut off.
    i = min(bi * size + size // 2, len(rays) - 2)
    for bj in range(begin, after):
        j = min(bj * size + size // 2, rays.shape[1] - 2)
        count = blocks.moments[bi, bj, COUNT]
        blocks.across[bi, bj] = blocks.down[bi, bj] = 0
        if i < 0 or j < 0 or count <= 3:
            continue
        theta = block_plane(lanes, bj - begin)
        if _known(rays, i, j) and _known(rays, i, j + 1) and _known(rays, i + 1, j):
            right, below = 0.0, 0.0
            for k in range(3):
                right += theta[k] * (rays[i, j + 1, k] - rays[i, j, k])
                below += theta[k] * (rays[i + 1, j, k] - rays[i, j, k])
        else:
            right = _change(theta, rays, (bi * size, bj * size), size, False)
            below = _change(theta, rays, (bi * size, bj * size), size, True)
        square = right * right + below * below
        noise = blocks.residual[bi, bj] / (count - 3) * doubt / count
        share = max(square - noise, 0.0) / max(square, 1e-300)
        blocks.across[bi, bj] = share * right * right
        blocks.down[bi, bj] = share * below * below


@njit(cache=True, inline='always')
def _known(rays: NDArray[np.float32], i: int, j: int) -> Any:
    """Whether a pixel has a ray: those of a cloud are 0 where nothing was measured."""
    return (rays[i, j, 0] != 0) | (rays[i, j, 1] != 0) | (rays[i, j, 2] != 0)


@njit(cache=True, nogil=True)
def _change(
    theta: Any, rays: NDArray[np.float32], corner: tuple[int, int], size: int, down: bool
) -> float:
    """Change of the inverse range from pixel to pixel on the plane of a block, with holes in it.

    Between the two rays of a column (`down`) or row that are farthest apart; 0 where none has two.
    """
    farthest, change = 0, 0.0
    for line in range(size):
        first, begin = -1, 0.0
        for place in range(size):
            i = corner[0] + (place if down else line)
            j = corner[1] + (line if down else place)
            if i >= rays.shape[0] or j >= rays.shape[1] or not _known(rays, i, j):
                continue
            level = theta[0] * rays[i, j, 0] + theta[1] * rays[i, j, 1] + theta[2] * rays[i, j, 2]
            if first < 0:
                first, begin = place, level
            elif place - first > farthest:
                farthest = place - first
                change = (level - begin) / farthest
    return change
