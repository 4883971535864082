"""Which regions are parts of one plane, seen apart."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.cells import Cells
from rangeseg_ros.core.moments import COUNT
from rangeseg_ros.core.uncertainty import Field, pairs

# Quantile 0.99 of chi-squared with the three degrees of freedom of a plane, and what the parts of
# a face differ by beyond their errors, as factor of variances: the residue of bands, of grazing
# views and of ragged borders, from 239 pairs of parts in simulated rooms (median 2.9). Of 725
# pairs of different faces that meet, one was within the quantile alone, and 14 are with it.
_LIMIT = 11.34 * 2.5


def common_surfaces(
    cells: Cells,
    theta: NDArray[np.float64],
    covariance: NDArray[np.float64],
    inverse: NDArray[np.float64],
    variances: NDArray[np.float64],
    distortion_length: float,
) -> NDArray[np.intp]:
    """Group regions whose planes differ by no more than their errors.

    From the largest region to the smallest, each joins the group whose largest member it agrees
    with best, or begins a new one: a small region of uncertain direction joins one group and
    ties no two together. Two planes agree when the chi-squared of their difference, which
    is what a joint fit adds to that of two separate ones, is what parts of a face have. The
    systematic errors of neighbouring regions are alike and cancel in the difference.

    Parameters
    ----------
    cells : Cells
        Of M + 1 regions.
    theta : (M + 1, 3) float64
        Their planes; zeros where there is none.
    covariance : (M + 1, 3, 3) float64
        Of theta.
    inverse : (M + 1, 3, 3) float64
        Of the sums of w r r^T.
    variances : (4,) float64
        Of the sensor.
    distortion_length : float
        Of the sensor, pixels.

    Returns
    -------
    (M + 1,) int
        Label of the largest region of the group; 0 where there is no plane.
    """
    order = np.argsort(-cells.regions()[:, COUNT], kind='stable')
    return _groups(
        order,
        cells,
        theta,
        covariance,
        inverse,
        variances,
        distortion_length,
    )


@njit(cache=True)
def _groups(
    order: NDArray[np.intp],
    cells: Cells,
    theta: NDArray[np.float64],
    covariance: NDArray[np.float64],
    inverse: NDArray[np.float64],
    variances: NDArray[np.float64],
    distortion_length: float,
) -> NDArray[np.intp]:
    surface = np.zeros(len(theta), np.intp)
    systematic = Field(distortion_length, variances[2], variances[3])
    for rank in range(len(order)):
        k = order[rank]
        if not theta[k].any():
            continue
        surface[k] = k
        least = _LIMIT
        for earlier in range(rank):
            m = order[earlier]
            if surface[m] != m:
                continue
            apart = theta[k] - theta[m]
            both = covariance[k] + covariance[m]
            if _chi_squared(apart, both) > _LIMIT:
                continue
            common = pairs(cells, k, theta[k], m, theta[m], systematic)
            common = _product(_product(inverse[k], common), inverse[m])
            value = _chi_squared(apart, both - common - common.T)
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
    """difference^T covariance^-1 difference."""
    # A sensor without errors still rounds: to 1e-9 / m.
    a, d, f = covariance[0, 0] + 1e-18, covariance[1, 1] + 1e-18, covariance[2, 2] + 1e-18
    b, c, e = covariance[0, 1], covariance[0, 2], covariance[1, 2]
    # By cofactors.
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * bb + c * cc
    if determinant <= 0:
        return np.inf
    p, q, r = difference[0], difference[1], difference[2]
    square = aa * p * p + dd * q * q + ff * r * r
    return (square + 2 * (bb * p * q + cc * p * r + ee * q * r)) / determinant
