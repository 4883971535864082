"""Square blocks of pixels: what tells the noise, and what surfaces are grown from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.moments import CHI2, COUNT, NO_PIXEL, SIZE, fit, plus_pixel
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

    def slope(self, way: tuple[float, float]) -> NDArray[np.float64]:
        """Sums (rows, columns) of so much of the squared slopes along the row and the column."""
        return way[0] * self.across + way[1] * self.down

    @classmethod
    def of(cls, image: RangeImage) -> Blocks:
        """Blocks of 4 x 4 pixels."""
        return cls.planes(block_moments(image.inverse, image.rays), image.rays, BLOCK)

    @classmethod
    def planes(cls, moments: NDArray[np.float64], rays: NDArray[np.float32], size: int) -> Blocks:
        """Planes of the blocks of `size` pixels with these moments."""
        squared = moments[..., CHI2] / np.maximum(moments[..., COUNT], 1)
        across, down, residual = (np.zeros_like(squared) for _ in range(3))
        run_rows(_fit_blocks, len(moments), moments, rays, size, across, down, residual)
        return cls(moments, squared, across, down, residual)


def block_moments(
    inverse: NDArray[np.float32], rays: NDArray[np.float32], size: int = BLOCK
) -> NDArray[np.float64]:
    """Moments, with unit weights, of the measured pixels of every block.

    Parameters
    ----------
    inverse, rays : (H, W), (H, W, 3) float32
        Range image; inverse is 0 where nothing was measured.
    size : int
        Rows and columns of a block.

    Returns
    -------
    (ceil(H / size), ceil(W / size), 13) float64
    """
    height, width = inverse.shape
    moments = np.zeros((-(-height // size), -(-width // size), SIZE))
    run_rows(_sum_blocks, len(moments), inverse, rays, size, moments)
    return moments


@njit(cache=True, nogil=True)
def _sum_blocks(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    size: int,
    moments: NDArray[np.float64],
) -> None:
    """Moments of rows of blocks."""
    height, width = inverse.shape
    for bi in range(first, after):
        bottom = min((bi + 1) * size, height)
        for bj in range(moments.shape[1]):
            right = min((bj + 1) * size, width)
            sums, count = NO_PIXEL, 0.0
            for i in range(bi * size, bottom):
                for j in range(bj * size, right):
                    y = np.float64(inverse[i, j])
                    if y == 0:
                        continue
                    x0 = np.float64(rays[i, j, 0])
                    x1 = np.float64(rays[i, j, 1])
                    x2 = np.float64(rays[i, j, 2])
                    sums = plus_pixel(sums, x0, x1, x2, y, 1.0)
                    count += 1
            for entry, value in enumerate(sums):
                moments[bi, bj, entry] = value
            moments[bi, bj, COUNT] = count


def quads(blocks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moments (ceil(rows / 2), ceil(columns / 2), 13) of every 2 x 2 blocks."""
    rows, columns = blocks.shape[:2]
    result = np.zeros(((rows + 1) // 2, (columns + 1) // 2, SIZE))
    run_rows(_sum_quads, len(result), blocks, result)
    return result


@njit(cache=True, nogil=True)
def _sum_quads(
    first: int, after: int, blocks: NDArray[np.float64], result: NDArray[np.float64]
) -> None:
    """The same for some of its rows."""
    rows, columns = blocks.shape[:2]
    for i in range(2 * first, min(2 * after, rows)):
        for j in range(columns):
            for k in range(SIZE):
                result[i // 2, j // 2, k] += blocks[i, j, k]


@njit(cache=True, nogil=True)
def _fit_blocks(
    first: int,
    after: int,
    moments: NDArray[np.float64],
    rays: NDArray[np.float32],
    size: int,
    across: NDArray[np.float64],
    down: NDArray[np.float64],
    residual: NDArray[np.float64],
) -> None:
    """Slopes and residuals of rows of blocks."""
    theta = np.zeros(3)
    # Variance of the slope in both directions together, of noise of unit variance.
    doubt = 2 * 12 / (size * size - 1)
    # The pixel in the middle of a block and its neighbours; the last block may be cut off.
    for bi in range(first, after):
        i = min(bi * size + size // 2, len(rays) - 2)
        for bj in range(moments.shape[1]):
            j = min(bj * size + size // 2, rays.shape[1] - 2)
            count = moments[bi, bj, COUNT]
            if count == 0:
                continue
            residual[bi, bj] = fit(moments[bi, bj], theta)
            if i < 0 or j < 0 or count <= 3:
                continue
            right, below = 0.0, 0.0
            for k in range(3):
                right += theta[k] * (rays[i, j + 1, k] - rays[i, j, k])
                below += theta[k] * (rays[i + 1, j, k] - rays[i, j, k])
            square = right * right + below * below
            noise = residual[bi, bj] / (count - 3) * doubt / count
            share = max(square - noise, 0.0) / max(square, 1e-300)
            across[bi, bj], down[bi, bj] = share * right * right, share * below * below
