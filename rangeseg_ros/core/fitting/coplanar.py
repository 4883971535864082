"""Which regions are parts of one plane: seen apart, or cut where nothing is."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.borders import Borders
from rangeseg_ros.core.fitting.cells import WEIGHT
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.uncertainty import pairs
from rangeseg_ros.core.sensing.moments import COUNT, cofactors
from rangeseg_ros.core.sensing.sensor import FLOOR, random_variance, systematic_variance
from rangeseg_ros.core.significance import chi2_quantile

RESIDUE = 2.5
"""What the parts of a face differ by beyond their errors, as factor of variances.

The residue of bands, of grazing views and of ragged borders, from 239 pairs of parts in simulated
rooms (median 2.9).
"""
# Of 725 pairs of different faces that meet, one was within the quantile alone, and 14 are with the
# residue.
_LIMIT = RESIDUE * chi2_quantile(3, 0.99)
# The same for regions that touch where no jump is. These are rarely parts of a face, but faces
# that meet there meet in a crease: of 2300 pairs in simulated and real frames, 11 of parts were
# apart by 0 to 56 (others, of bent or ragged parts, by more), those of faces by 119 at least.
_TOUCHING = 6.0
_TOUCHING_LIMIT = _TOUCHING * chi2_quantile(3, 0.99)
_LEVEL = chi2_quantile(1, 0.99)


@njit(cache=True, nogil=True)
def common_surfaces(fits: Fits) -> NDArray[np.intp]:
    """Group regions whose planes differ by no more than their errors.

    From the largest region to the smallest, each joins the group whose largest member it agrees
    with best, or begins a new one: a small region of uncertain direction joins one group and
    ties no two together. Two planes agree when the chi-squared of their difference, which
    is what a joint fit adds to that of two separate ones, is what parts of a face have. The
    systematic errors of neighbouring regions are alike and cancel in the difference.

    Parameters
    ----------
    fits : Fits
        Of M + 1 regions.

    Returns
    -------
    (M + 1,) int
        Label of the largest region of the group; 0 where there is no plane.
    """
    order = _by_falling_size(fits)
    surface, nothing = np.zeros(len(fits.theta), np.intp), np.zeros((3, 3))
    for rank in range(len(order)):
        k = order[rank]
        surface[k] = k
        least = _LIMIT
        for m in order[:rank]:
            if surface[m] == m:
                # Most are far apart, and need no call: it counts references to all of the fits.
                value = _chi_squared(fits, k, m, nothing)
                if value <= _LIMIT:
                    value = _difference(fits, k, m)
                if value < least:
                    least, surface[k] = value, m
    return surface


@njit(cache=True, nogil=True)
def group_coplanar(fits: Fits, borders: Borders, agreement: float) -> NDArray[np.intp]:
    """Group regions that touch and whose planes agree, as `common_surfaces` does.

    What lies within a region, and on average no higher or deeper, is a part of it however its
    own plane is tilted: a dent, or what the sensor saw as one. Where jumps cut more than half of
    their common border, regions have to agree as those seen apart do: between a step and what is
    behind it there may be gaps in the jump, and on a face there may be jumps that are none. Where
    they cut all of it, it is a border.

    Parameters
    ----------
    fits : Fits
        Of M + 1 regions.
    borders : Borders
        Of them.
    agreement : float
        Of the sensor.

    Returns
    -------
    (M + 1,) int
        Label of the largest region of the group; 0 where there is no plane.
    """
    around = _around(fits, borders, agreement)
    group, nothing = np.zeros(len(fits.theta), np.intp), np.zeros((3, 3))
    for k in _by_falling_size(fits):
        # 0 while the region around, then the smaller one, has had no turn.
        group[k] = group[around[k]]
        if group[k] > 0:
            continue
        group[k] = k
        least = _TOUCHING_LIMIT
        for e in range(borders.start[k], borders.start[k + 1]):
            # 0 while the region at the other end, smaller, has had no turn.
            leader = group[borders.other[e]]
            if leader > 0 and leader != k:
                limit = _LIMIT if borders.links[e] > 0 else 0.0
                if borders.links[e] >= borders.cuts[e]:
                    limit = _TOUCHING_LIMIT
                value = _chi_squared(fits, k, leader, nothing)
                if value <= limit:
                    value = _difference(fits, k, leader)
                if value < min(least, limit):
                    least, group[k] = value, leader
    return group


@njit(cache=True)
def _around(fits: Fits, borders: Borders, agreement: float) -> NDArray[np.intp]:
    """Region (M + 1,) that each lies in, neither before nor behind it; 0 for none."""
    count = len(fits.theta)
    result = np.zeros(count, np.intp)
    for inner in range(count):
        for e in range(borders.start[inner], borders.start[inner + 1]):
            # Two planes meet along a line, and a line is never more than half of an outline.
            if 2 * (borders.links[e] - borders.cuts[e]) <= borders.length[inner]:
                continue
            theta, sums = fits.theta[borders.other[e]], fits.explained[inner]
            a, b, c = theta
            square = a * (a * sums[0] + 2 * (b * sums[1] + c * sums[2]))
            square += b * (b * sums[3] + 2 * c * sums[4]) + c * c * sums[5]
            along = a * sums[6] + b * sums[7] + c * sums[8]
            share = along / max(square, FLOOR) - 1
            level = square / max(sums[WEIGHT], FLOOR)
            doubt = agreement / max(sums[COUNT], 1.0)
            variance = systematic_variance(fits.sensor, level)
            variance += doubt * random_variance(fits.sensor, level)
            if share**2 * level < _LEVEL * variance:
                result[inner] = borders.other[e]
    return result


@njit(cache=True)
def _by_falling_size(fits: Fits) -> NDArray[np.intp]:
    """Regions that have planes; of the same size by rising number."""
    order = np.empty(len(fits.theta), np.intp)
    count = 0
    for k in range(len(order)):
        if not fits.theta[k].any():
            continue
        # Nearly so they are numbered.
        place = count
        while place > 0 and fits.pixels[order[place - 1]] < fits.pixels[k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
        count += 1
    return order[:count]


@njit(cache=True)
def _difference(fits: Fits, k: int, m: int) -> float:
    """Chi-squared of the difference of two planes, whose systematic errors are alike."""
    common = np.zeros((3, 3))
    for a in fits.parts[fits.start[k] : fits.start[k + 1]]:
        for b in fits.parts[fits.start[m] : fits.start[m + 1]]:
            common += pairs(fits.cells, a, fits.theta[k], b, fits.theta[m], fits.systematic)
    return _chi_squared(fits, k, m, _product(_product(fits.inverse[k], common), fits.inverse[m]))


@njit(cache=True)
def _product(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    # The compiler takes seconds to bind the linear algebra of libraries.
    result = np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            for c in range(3):
                result[a, c] += left[a, b] * right[b, c]
    return result


@njit(cache=True, inline='always')
def _chi_squared(fits: Fits, k: int, m: int, common: NDArray[np.float64]) -> float:
    """Chi-squared of the difference of two planes whose covariance with each other is `common`."""
    # A sensor without errors still rounds: to 1e-9 / m.
    a, d, f = (
        _of_difference(fits, k, m, common, 0, 0) + 1e-18,
        _of_difference(fits, k, m, common, 1, 1) + 1e-18,
        _of_difference(fits, k, m, common, 2, 2) + 1e-18,
    )
    b, c = _of_difference(fits, k, m, common, 0, 1), _of_difference(fits, k, m, common, 0, 2)
    e = _of_difference(fits, k, m, common, 1, 2)
    aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
    if determinant <= 0:
        return np.inf
    p = fits.theta[k, 0] - fits.theta[m, 0]
    q, r = fits.theta[k, 1] - fits.theta[m, 1], fits.theta[k, 2] - fits.theta[m, 2]
    square = aa * p * p + dd * q * q + ff * r * r
    return (square + 2 * (bb * p * q + cc * p * r + ee * q * r)) / determinant


@njit(cache=True, inline='always')
def _of_difference(
    fits: Fits, k: int, m: int, common: NDArray[np.float64], a: int, b: int
) -> float:
    """An entry of the covariance of the difference of two planes."""
    both = fits.covariance[k, a, b] + fits.covariance[m, a, b]
    return both - common[a, b] - common[b, a]
