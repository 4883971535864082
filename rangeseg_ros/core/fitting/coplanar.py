"""Which regions, seen apart, are parts of one plane."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.uncertainty import Cells, add_common_errors, distortion_field
from rangeseg_ros.core.sensing.moments import cofactors
from rangeseg_ros.core.significance import chi2_quantile

RESIDUE = 2.5
"""What the parts of a face differ by beyond their errors, as factor of variances.

The residue of bands, of grazing views and of ragged borders, from 239 pairs of parts in simulated
rooms (median 2.9).
"""
# Of 725 pairs of different faces that meet, one was within the quantile alone, and 14 are with the
# residue.
_LIMIT = RESIDUE * chi2_quantile(3, 0.99)


def common_surfaces(fits: Fits, covariance: NDArray[np.float64]) -> NDArray[np.intp]:
    """Group regions whose planes differ by no more than their errors.

    From the largest region to the smallest, each joins the group whose largest member it agrees
    with best: a small region of uncertain direction ties no two together. Planes agree when the
    chi-squared of their difference is what parts of a face have; the systematic errors of
    neighbours are alike and cancel in it. Returns the label (M + 1,) of the largest region of each
    one's group, 0 where there is no plane.
    """
    order = np.argsort(-fits.sums.pixels, kind='stable')
    order = order[fits.theta[order].any(axis=1)]
    cells = Cells.of(fits.sums, fits.level, distortion_field(fits.sensor))
    return _surfaces(order, fits.sums.start, fits.theta, fits.inverses(), covariance, cells)


@njit(cache=True, nogil=True)
def _surfaces(
    order: NDArray[np.intp],
    start: NDArray[np.intp],
    theta: NDArray[np.float64],
    inverse: NDArray[np.float64],
    covariance: NDArray[np.float64],
    cells: Cells,
) -> NDArray[np.intp]:
    surface = np.zeros(len(theta), np.intp)
    for rank in range(len(order)):
        k = order[rank]
        surface[k] = k
        least = _LIMIT
        for m in order[:rank]:
            if surface[m] != m:
                continue
            both = covariance[k] + covariance[m]
            value = _chi_squared(theta[k] - theta[m], both)
            if value <= _LIMIT:
                common = np.zeros((3, 3))
                own, other = (start[k], start[k + 1]), (start[m], start[m + 1])
                add_common_errors(cells, own, other, common)
                common = _product(_product(inverse[k], common), inverse[m])
                value = _chi_squared(theta[k] - theta[m], both - common - common.T)
            if value < least:
                least, surface[k] = value, m
    return surface


@njit(cache=True)
def _product(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    # The compiler takes seconds to bind the linear algebra of libraries.
    result = np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            for c in range(3):
                result[a, c] += left[a, b] * right[b, c]
    return result


@njit(cache=True)
def _chi_squared(difference: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Chi-squared of the difference of two planes; infinite for no covariance."""
    # A sensor without errors still rounds: to 1e-9 / m.
    a, d, f = covariance[0, 0] + 1e-18, covariance[1, 1] + 1e-18, covariance[2, 2] + 1e-18
    b, c, e = covariance[0, 1], covariance[0, 2], covariance[1, 2]
    aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
    if determinant <= 0:
        return np.inf
    p, q, r = difference
    square = aa * p * p + dd * q * q + ff * r * r
    return (square + 2 * (bb * p * q + cc * p * r + ee * q * r)) / determinant
