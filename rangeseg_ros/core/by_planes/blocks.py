"""Square blocks of pixels: what surfaces are grown from, and what tells the noise."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import strips
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.moments import CHI2, COUNT, RATIO, SIZE, SLOPE, fit
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    random_variance,
    systematic_variance,
)

# Share of a block that must have been measured.
_MEASURED = 0.7

# (rows, columns-1) and (rows-1, columns): whether a block touches its right, its lower neighbour.
Links = tuple[NDArray[np.bool_], NDArray[np.bool_]]


def block_size(shape: tuple[int, int]) -> int:
    """Rows and columns of the blocks of an image: 4 pixels up to twice VGA, 8 above.

    Blocks of 4 pixels find faces 10 pixels wide; a larger image shows the same face larger.
    """
    return 4 if shape[0] * shape[1] <= 2 * 640 * 480 else 8


def block_moments(
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    grid: Grid,
    size: int,
) -> NDArray[np.float64]:
    """Moments, with unit weights, of the blocks that nothing disturbs.

    Parameters
    ----------
    inverse, rays : (H, W), (H, W, 3) float32
        Range image; inverse is 0 where nothing was measured.
    grid : Grid
        0 across jumps.
    size : int
        Rows and columns of a block.

    Returns
    -------
    (ceil(H / size), ceil(W / size), 13) float64
        Zeros for blocks that a jump edge crosses or that lack measurements in over 30 %.
    """
    height, width = inverse.shape
    moments = np.zeros((-(-height // size), -(-width // size), SIZE))
    strips(_block_moments, len(moments), inverse, rays, grid, size, moments)
    return moments


@njit(cache=True, nogil=True)
def _block_moments(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    grid: Grid,
    size: int,
    moments: NDArray[np.float64],
) -> None:
    """Moments of rows of blocks."""
    height, width = inverse.shape
    for bi in range(first, after):
        bottom = min((bi + 1) * size, height)
        for bj in range(moments.shape[1]):
            right = min((bj + 1) * size, width)
            # In variables of their own: sums in an array go through memory for every pixel.
            a = b = c = d = e = f = p = q = r = square = count = 0.0
            whole = True
            for i in range(bi * size, bottom):
                for j in range(bj * size, right):
                    y = np.float64(inverse[i, j])
                    if y == 0:
                        continue
                    x0 = np.float64(rays[i, j, 0])
                    x1 = np.float64(rays[i, j, 1])
                    x2 = np.float64(rays[i, j, 2])
                    a, b, c = a + x0 * x0, b + x0 * x1, c + x0 * x2
                    d, e, f = d + x1 * x1, e + x1 * x2, f + x2 * x2
                    p, q, r = p + x0 * y, q + x1 * y, r + x2 * y
                    square += y * y
                    count += 1
                    if j + 1 < right and inverse[i, j + 1] > 0:
                        whole &= grid.right[i, j] > 0
                    if i + 1 < bottom and inverse[i + 1, j] > 0:
                        whole &= grid.below[i, j] > 0
            if whole and count >= _MEASURED * size * size:
                for entry, value in enumerate((a, b, c, d, e, f, p, q, r, square, count)):
                    moments[bi, bj, entry] = value


@njit(cache=True)
def block_links(grid: Grid, size: int) -> Links:
    """Whether a block touches its right, its lower neighbour: along half of their border at least.

    Parameters
    ----------
    grid : Grid
    size : int
        Rows and columns of a block.

    Returns
    -------
    right, below : (rows, columns-1), (rows-1, columns) bool
    """
    height, width = len(grid.right), grid.below.shape[1]
    rows, columns = -(-height // size), -(-width // size)
    right = np.zeros((rows, columns - 1), np.bool_)
    below = np.zeros((rows - 1, columns), np.bool_)
    for bi in range(rows):
        for bj in range(columns - 1):
            touching = 0
            for i in range(bi * size, min((bi + 1) * size, height)):
                touching += grid.right[i, (bj + 1) * size - 1] > 0
            right[bi, bj] = 2 * touching >= size
    for bi in range(rows - 1):
        for bj in range(columns):
            touching = 0
            for j in range(bj * size, min((bj + 1) * size, width)):
                touching += grid.below[(bi + 1) * size - 1, j] > 0
            below[bi, bj] = 2 * touching >= size
    return right, below


@njit(cache=True)
def slopes_and_residuals(
    blocks: NDArray[np.float64], rays: NDArray[np.float32], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What the plane of each block tells.

    Parameters
    ----------
    blocks : (rows, columns, 13) float64
        With unit weights.
    rays : (H, W, 3) float32
    size : int

    Returns
    -------
    slope : (rows, columns) float64
        Change of the inverse range from pixel to pixel, 1/m.
    residual : (rows, columns) float64
        Sum of the squared residuals, 1/m^2.
    """
    rows, columns = blocks.shape[:2]
    slope, residual = np.zeros((rows, columns)), np.zeros((rows, columns))
    theta = np.zeros(3)
    # The pixel in the middle of a block and its neighbours; the last block may be cut off.
    for bi in range(rows):
        i = min(bi * size + size // 2, len(rays) - 2)
        for bj in range(columns):
            j = min(bj * size + size // 2, rays.shape[1] - 2)
            if blocks[bi, bj, COUNT] == 0:
                continue
            residual[bi, bj] = fit(blocks[bi, bj], theta)
            if i < 0 or j < 0:
                continue
            across, down = 0.0, 0.0
            for k in range(3):
                across += theta[k] * (rays[i, j + 1, k] - rays[i, j, k])
                down += theta[k] * (rays[i + 1, j, k] - rays[i, j, k])
            slope[bi, bj] = np.sqrt(across * across + down * down)
    return slope, residual


def residual_noise(
    blocks: NDArray[np.float64], residual: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean inverse range and unbiased mean square residual of the complete blocks.

    Parameters
    ----------
    blocks : (rows, columns, 13) float64
        With unit weights.
    residual : (rows, columns) float64
        Sums of squares.
    size : int
        Rows and columns of a block.
    """
    complete = blocks[..., COUNT] == size * size
    return np.sqrt(blocks[complete, CHI2]) / size, residual[complete] / (size * size - 3)


@njit(cache=True)
def weighted(
    blocks: NDArray[np.float64], sensor: SensorModel, slope: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Blocks with weights according to the sensor, and the ratios of its variances.

    Parameters
    ----------
    blocks : (rows, columns, 13) float64
        With unit weights.
    sensor : SensorModel
    slope : (rows, columns) float64
        See `slopes_and_residuals`.
    """
    result = np.zeros_like(blocks)
    for i in range(blocks.shape[0]):
        for j in range(blocks.shape[1]):
            count = blocks[i, j, COUNT]
            if count == 0:
                continue
            squared = blocks[i, j, CHI2] / count
            level = random_variance(sensor, squared)
            tilt = (sensor.pixel_noise * slope[i, j]) ** 2 / level
            weight = 1 / (level * (1 + tilt))
            for entry in range(COUNT):
                result[i, j, entry] = weight * blocks[i, j, entry]
            result[i, j, COUNT] = count
            result[i, j, RATIO] = count * weight * systematic_variance(sensor, squared)
            result[i, j, SLOPE] = count * tilt
    return result
