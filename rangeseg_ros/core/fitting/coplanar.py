"""Which regions, seen apart, are parts of one plane."""

from __future__ import annotations

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Indices
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.sensing.moments import cofactors
from rangeseg_ros.core.significance import chi2_quantile

_LIMIT = chi2_quantile(3, 0.99)


def common_surfaces(fits: Fits, covariance: Floats) -> Indices:
    """Group regions whose planes differ by no more than their errors.

    From the largest region to the smallest, each joins the group whose largest member it agrees
    with best, by chi-squared of their difference: a small region of uncertain direction ties no
    two together. Returns the label (M + 1,) of the largest region of each one's group, 0 where
    there is no plane.
    """
    order = np.argsort(-fits.sums.pixels, kind='stable')
    order = order[fits.theta[order].any(axis=1)]
    return _surfaces(order, fits.theta, covariance)


@njit(cache=True, nogil=True)
def _surfaces(order: Indices, theta: Floats, covariance: Floats) -> Indices:
    surface = np.zeros(len(theta), np.intp)
    for rank in range(len(order)):
        k = order[rank]
        surface[k], least = k, _LIMIT
        for m in order[:rank]:
            if surface[m] != m:
                continue
            value = _chi_squared(theta[k] - theta[m], covariance[k] + covariance[m])
            if value < least:
                least, surface[k] = value, m
    return surface


@njit(cache=True)
def _chi_squared(difference: Floats, covariance: Floats) -> float:
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
