"""Moments that add up over pixels, blocks and regions, and the planes they determine.

A plane is linear in inverse range, theta . ray = inverse with theta = -normal / distance, so its
weighted least-squares fit needs only sums over the pixels. A moment vector holds thirteen of
them, for rays r, inverse range y and weights w = 1 / random variance: w r r^T (upper triangle,
6), w r y (3), w y^2, the number of pixels, the ratio of systematic to random variance, and that
of the variance which the slope of the surface adds to the rest of the random variance. Residual
sums of squares thus count random variances.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Singles

SIZE = 13  # of the vector of sums
# Entries: w y^2, number of pixels, sums of the two variance ratios.
CHI2, COUNT, RATIO, SLOPE = 9, 10, 11, 12
# Rows and columns of the entries of an upper triangle, and which of these are in a whole matrix.
ROWS, COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
SYMMETRIC = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
NO_PIXEL = (0.0,) * (CHI2 + 1)  # see `plus_pixel`


@register_jitable
def cofactors(a: Any, b: Any, c: Any, d: Any, e: Any, f: Any) -> tuple[Any, ...]:
    """Cofactors of the symmetric matrix [[a, b, c], [b, d, e], [c, e, f]], and its determinant.

    Of numbers in kernels, and of arrays; over the determinant they are the inverse, in that order.
    """
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    return aa, bb, cc, dd, ee, ff, a * aa + b * bb + c * cc


@njit(cache=True, inline='always')
def ray_of(rays: Singles, pinhole: bool, i: int, j: int) -> tuple[Any, Any, Any]:
    """Ray of a pixel; of a pinhole camera from the first row and column, which stay in cache."""
    row, column = (0, 0) if pinhole else (i, j)
    return rays[row, j, 0], rays[i, column, 1], rays[row, j, 2]


@njit(cache=True, inline='always')
def plus_pixel(
    sums: tuple[float, ...], x: float, y: float, z: float, inverse: float, weight: float
) -> tuple[float, ...]:
    """The first ten sums of a moment vector, `NO_PIXEL` at first, with one more ray (x, y, z).

    A tuple, which the compiler keeps in registers, and not in memory as an array.
    """
    a, b, c, d, e, f, p, q, r, square = sums
    wx, wy, wz = weight * x, weight * y, weight * z
    return (
        a + wx * x,
        b + wx * y,
        c + wx * z,
        d + wy * y,
        e + wy * z,
        f + wz * z,
        p + wx * inverse,
        q + wy * inverse,
        r + wz * inverse,
        square + weight * inverse * inverse,
    )


@njit(cache=True, inline='always')
def plane_of(sums: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Least-squares plane of the first ten sums of a moment vector, and the squares it leaves.

    Zeros and all squares where the pixels do not determine one. For kernels of the error model
    'numpy': without branches, so that the compiler takes many at a time.
    """
    a, b, c, d, e, f, p, q, r, _ = sums
    aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
    scale = 1 / determinant if determinant > 1e-13 * a * d * f else 0.0
    x = scale * (aa * p + bb * q + cc * r)
    y = scale * (bb * p + dd * q + ee * r)
    z = scale * (cc * p + ee * q + ff * r)
    left = squares_left(sums, (x, y, z))
    return x, y, z, left if left > 0 else 0.0


@njit(cache=True, inline='always')
def squares_left(sums: tuple[float, ...], theta: tuple[float, float, float]) -> float:
    """Sum of the squared residuals that a plane leaves, of the first ten sums of a vector."""
    (a, b, c, d, e, f, p, q, r, square), (x, y, z) = sums, theta
    # Not square - x p - y q - z r: where pixels lie in nearly one direction, theta is inaccurate,
    # and its error enters there linearly, here squared.
    left = square - 2 * (x * p + y * q + z * r)
    return left + (x * (a * x + 2 * (b * y + c * z)) + y * (d * y + 2 * e * z) + f * z * z)


@njit(cache=True, inline='always')
def sums_of(moments: Floats, k: int) -> tuple[float, ...]:
    """The first ten sums of one of N moment vectors (N, 13)."""
    return (
        moments[k, 0],
        moments[k, 1],
        moments[k, 2],
        moments[k, 3],
        moments[k, 4],
        moments[k, 5],
        moments[k, 6],
        moments[k, 7],
        moments[k, 8],
        moments[k, CHI2],
    )


@njit(cache=True, error_model='numpy')
def fit(moments: Floats, k: int, theta: Floats) -> float:
    """Write the plane of one of N moment vectors, or zeros, to theta (N, 3); squares it leaves."""
    theta[k, 0], theta[k, 1], theta[k, 2], left = plane_of(sums_of(moments, k))
    return left


@njit(cache=True, error_model='numpy')
def common_residual(moments: Floats, k: int, m: int) -> float:
    """What `fit` returns for the sum of two of N moment vectors (N, 13), without views of them.

    Call it with numbers of type intp: it is compiled once for each type of integer.
    """
    sums = (
        moments[k, 0] + moments[m, 0],
        moments[k, 1] + moments[m, 1],
        moments[k, 2] + moments[m, 2],
        moments[k, 3] + moments[m, 3],
        moments[k, 4] + moments[m, 4],
        moments[k, 5] + moments[m, 5],
        moments[k, 6] + moments[m, 6],
        moments[k, 7] + moments[m, 7],
        moments[k, 8] + moments[m, 8],
        moments[k, CHI2] + moments[m, CHI2],
    )
    return plane_of(sums)[3]


@njit(cache=True)
def fit_all(moments: Floats) -> tuple[Floats, Floats]:
    """Planes (N, 3) and residual sums (N,) of moment vectors (N, 13)."""
    theta = np.zeros((len(moments), 3))
    residual = np.zeros(len(moments))
    for i in range(len(moments)):
        residual[i] = fit(moments, i, theta)
    return theta, residual


@njit(cache=True, nogil=True)
def sum_by_label(labels: NDArray[np.integer], values: Floats, count: int) -> Floats:
    """Sums (count, K) of the values (N, K) of each of the labels (N,) above 0."""
    total = np.zeros((count, values.shape[1]))
    for n in range(len(labels)):
        if labels[n] > 0:
            for k in range(values.shape[1]):
                total[labels[n], k] += values[n, k]
    return total
