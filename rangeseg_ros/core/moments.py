"""Moments that add up over pixels, blocks and regions, and the planes they determine.

A plane is linear in inverse range, theta . ray = inverse with theta = -normal / distance, so its
weighted least-squares fit needs only sums over the pixels. A moment vector holds thirteen of
them, for rays r, inverse range y and weights w = 1 / random variance: w r r^T (upper triangle,
6), w r y (3), w y^2, the number of pixels, the ratio of systematic to random variance, and that
of the variance which the slope of the surface adds to the rest of the random variance. Residual
sums of squares thus count random variances.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.sensor import SensorModel

SIZE = 13
CHI2, COUNT, RATIO, SLOPE = 9, 10, 11, 12
"""Entries of a moment vector: w y^2, number of pixels, sums of the two variance ratios."""


@njit(cache=True)
def fit(moments: NDArray[np.float64], theta: NDArray[np.float64]) -> float:
    """Least-squares plane of a moment vector.

    Parameters
    ----------
    moments : (13,) float64
    theta : (3,) float64
        Receives the plane; zeros where the pixels do not determine one.

    Returns
    -------
    float
        Weighted sum of the squared residuals.
    """
    a, b, c, d, e, f = moments[0], moments[1], moments[2], moments[3], moments[4], moments[5]
    p, q, r = moments[6], moments[7], moments[8]
    # Cofactors of the symmetric 3x3 matrix.
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * bb + c * cc
    if determinant <= 1e-13 * a * d * f:
        theta[:] = 0
        return moments[CHI2]
    theta[0] = (aa * p + bb * q + cc * r) / determinant
    theta[1] = (bb * p + dd * q + ee * r) / determinant
    theta[2] = (cc * p + ee * q + ff * r) / determinant
    return max(moments[CHI2] - theta[0] * p - theta[1] * q - theta[2] * r, 0.0)


@njit(cache=True)
def common_residual(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Weighted sum of the squared residuals of one plane for two moment vectors (13,).

    What `fit` returns for their sum, without memory traffic: growing spends its time here.
    """
    a, b, c = first[0] + second[0], first[1] + second[1], first[2] + second[2]
    d, e, f = first[3] + second[3], first[4] + second[4], first[5] + second[5]
    p, q, r = first[6] + second[6], first[7] + second[7], first[8] + second[8]
    square = first[CHI2] + second[CHI2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * bb + c * cc
    if determinant <= 1e-13 * a * d * f:
        return square
    explained = p * (aa * p + 2 * (bb * q + cc * r)) + q * (dd * q + 2 * ee * r) + ff * r * r
    return max(square - explained / determinant, 0.0)


@njit(cache=True)
def fit_all(moments: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Planes (N, 3) and residual sums (N,) of moment vectors (N, 13)."""
    theta = np.zeros((len(moments), 3))
    residual = np.zeros(len(moments))
    for i in range(len(moments)):
        residual[i] = fit(moments[i], theta[i])
    return theta, residual


@njit(cache=True)
def add_pixel(moments: NDArray[np.float64], ray: NDArray[np.float32], y: float, w: float) -> None:
    """Add a pixel of weight `w` to all entries of a moment vector but the variance ratios."""
    x0, x1, x2 = float(ray[0]), float(ray[1]), float(ray[2])
    moments[0] += w * x0 * x0
    moments[1] += w * x0 * x1
    moments[2] += w * x0 * x2
    moments[3] += w * x1 * x1
    moments[4] += w * x1 * x2
    moments[5] += w * x2 * x2
    moments[6] += w * x0 * y
    moments[7] += w * x1 * y
    moments[8] += w * x2 * y
    moments[9] += w * y * y
    moments[10] += 1


def block_size(shape: tuple[int, int]) -> int:
    """Rows and columns of the blocks of an image: 4 pixels up to twice VGA, 8 above.

    Blocks of 4 pixels find faces 10 pixels wide; a larger image shows the same face larger.
    """
    return 4 if shape[0] * shape[1] <= 2 * 640 * 480 else 8


@njit(cache=True)
def block_moments(
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    horizontal: NDArray[np.float32],
    vertical: NDArray[np.float32],
    size: int,
) -> NDArray[np.float64]:
    """Moments, with unit weights, of the square blocks that nothing disturbs.

    Parameters
    ----------
    inverse, rays : (H, W), (H, W, 3) float32
        Range image; inverse is 0 where nothing was measured.
    horizontal, vertical : (H, W-1), (H-1, W) float32
        Neighbourhood weights, 0 across jumps.
    size : int
        Rows and columns of a block.

    Returns
    -------
    (ceil(H / size), ceil(W / size), 13) float64
        Zeros for blocks that a jump edge crosses or that lack measurements in over 30 %.
    """
    height, width = inverse.shape
    rows, columns = -(-height // size), -(-width // size)
    moments = np.zeros((rows, columns, SIZE))
    for bi in range(rows):
        for bj in range(columns):
            block = moments[bi, bj]
            whole = True
            for i in range(bi * size, min((bi + 1) * size, height)):
                for j in range(bj * size, min((bj + 1) * size, width)):
                    if inverse[i, j] == 0:
                        continue
                    add_pixel(block, rays[i, j], inverse[i, j], 1.0)
                    if j + 1 < min((bj + 1) * size, width) and inverse[i, j + 1] > 0:
                        whole &= horizontal[i, j] > 0
                    if i + 1 < min((bi + 1) * size, height) and inverse[i + 1, j] > 0:
                        whole &= vertical[i, j] > 0
            if not whole or block[COUNT] < 0.7 * size * size:
                block[:] = 0
    return moments


def block_links(
    horizontal: NDArray[np.float32], vertical: NDArray[np.float32], size: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether a block touches its right, its lower neighbour: along half of their border at least.

    Parameters
    ----------
    horizontal, vertical : (H, W-1), (H-1, W) float32
        Neighbourhood weights.
    size : int
        Rows and columns of a block.

    Returns
    -------
    right, below : (rows, columns-1), (rows-1, columns) bool
    """
    rows, columns = -(-len(horizontal) // size), -(-vertical.shape[1] // size)
    right = (horizontal[:, size - 1 :: size] > 0)[:, : columns - 1]
    below = (vertical[size - 1 :: size] > 0)[: rows - 1]
    right_pixels = np.add.reduceat(right.view(np.uint8), np.arange(0, len(right), size), axis=0)
    below_pixels = np.add.reduceat(
        below.view(np.uint8), np.arange(0, below.shape[1], size), axis=1
    )
    return 2 * right_pixels >= size, 2 * below_pixels >= size


def residual_noise(
    blocks: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean inverse range and unbiased mean square residual of the complete blocks.

    Parameters
    ----------
    blocks : (rows, columns, 13) float64
        With unit weights.
    size : int
        Rows and columns of a block.
    """
    complete = blocks[blocks[..., COUNT] == size * size]
    _, residual = fit_all(complete)
    return np.sqrt(complete[:, CHI2]) / size, residual / (size * size - 3)


@njit(cache=True)
def slopes(
    blocks: NDArray[np.float64], rays: NDArray[np.float32], size: int
) -> NDArray[np.float64]:
    """Change of the inverse range from pixel to pixel in each block, (rows, columns), 1/m."""
    rows, columns = blocks.shape[:2]
    slope = np.zeros((rows, columns))
    theta = np.zeros(3)
    # The pixel in the middle of a block and its neighbours; the last block may be cut off.
    for bi in range(rows):
        i = min(bi * size + size // 2, len(rays) - 2)
        for bj in range(columns):
            j = min(bj * size + size // 2, rays.shape[1] - 2)
            if blocks[bi, bj, COUNT] == 0 or i < 0 or j < 0:
                continue
            fit(blocks[bi, bj], theta)
            across, down = 0.0, 0.0
            for k in range(3):
                across += theta[k] * (rays[i, j + 1, k] - rays[i, j, k])
                down += theta[k] * (rays[i + 1, j, k] - rays[i, j, k])
            slope[bi, bj] = np.sqrt(across * across + down * down)
    return slope


def weighted(
    blocks: NDArray[np.float64], sensor: SensorModel, slope: NDArray[np.float64] | float = 0.0
) -> NDArray[np.float64]:
    """Blocks with weights according to the sensor, and the ratios of its variances.

    Parameters
    ----------
    blocks : (rows, columns, 13) float64
        With unit weights.
    sensor : SensorModel
    slope : (rows, columns) float64
        See `slopes`.
    """
    result = blocks.copy()
    inverse = np.sqrt(blocks[..., CHI2] / np.maximum(blocks[..., COUNT], 1))
    level = sensor.variance(inverse)
    tilt = (sensor.pixel_noise * slope) ** 2 / level
    weight = 1 / (level * (1 + tilt))
    result[..., :COUNT] *= weight[..., None]
    result[..., RATIO] = blocks[..., COUNT] * sensor.systematic_variance(inverse) * weight
    result[..., SLOPE] = blocks[..., COUNT] * tilt
    return result
