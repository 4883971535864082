"""Quadratics in the pixel coordinates, fitted by least squares."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

# Exponents of x and y in the terms of a quadratic, in the powers of x and y up to the fourth, and
# which of these are the products of two terms.
_TERMS = [(n - b, b) for n in range(3) for b in range(n + 1)]
_POWERS = [(a, b) for b in range(5) for a in range(5 - b)]
_PRODUCTS = np.array([[_POWERS.index((a + c, b + d)) for c, d in _TERMS] for a, b in _TERMS])


@njit(cache=True, inline='always')
def add_terms(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    y: float,
    powers: tuple[float, float, float, float, float],
    residuals: tuple[float, float, float],
) -> None:
    """Add pixels at one y to the normal equations of a quadratic.

    Given are the sums of x^0 ... x^4 over them, and of their residuals times x^0 ... x^2.
    """
    entry, of_y = 0, 1.0
    for b in range(5):
        for a in range(5 - b):
            normal[entry] += powers[a] * of_y
            entry += 1
        of_y *= y
    t0, t1, t2 = residuals
    for entry, value in enumerate((t0, t1, t0 * y, t2, t1 * y, t0 * y * y)):
        right[entry] += value


@njit(cache=True)
def explained(powers: NDArray[np.float64], right: NDArray[np.float64]) -> tuple[float, float]:
    """Sums of squares that the linear terms of a fit explain, and that its quadratic ones add.

    With the normal equations A = L L^T (Cholesky), b^T A^-1 b is |L^-1 b|^2, and the first terms
    have the first rows to themselves.
    """
    half = _halved(powers, right)
    return (half[:3] ** 2).sum(), (half[3:] ** 2).sum()


@njit(cache=True)
def _halved(powers: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """L^-1 b."""
    ridge = 1e-9 * max(powers[0], 1.0)
    root, half = np.zeros((6, 6)), np.zeros(6)
    for a in range(6):
        half[a] = right[a]
        for b in range(a + 1):
            entry = powers[_PRODUCTS[a, b]]
            for c in range(b):
                entry -= root[a, c] * root[b, c]
            if a == b:
                root[a, a] = np.sqrt(entry + ridge)
            else:
                root[a, b] = entry / root[b, b]
                half[a] -= root[a, b] * half[b]
        half[a] /= root[a, a]
    return half
