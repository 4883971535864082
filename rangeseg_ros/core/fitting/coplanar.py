"""Which regions are parts of one plane: seen apart, or cut where nothing is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.cells import WEIGHT
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.uncertainty import pairs
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.moments import COUNT, cofactors
from rangeseg_ros.core.sensing.sensor import FLOOR, random_variance, systematic_variance
from rangeseg_ros.core.significance import chi2_quantile

# Pairs of regions, and what links and cuts them, see `find_borders`.
BorderRuns = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]

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
    return _groups(_by_falling_size(fits), fits)


@njit(cache=True, nogil=True)
def find_borders(
    regions: NDArray[np.uint16],
    grid: Grid,
    count: int,
    inner: NDArray[np.uint16],
) -> BorderRuns:
    """Where regions touch, and whether jumps are between them.

    Parameters
    ----------
    regions : (H, W) uint16
        0...M.
    grid : Grid
    count : int
        M + 1.
    inner : (rows, columns) uint16
        Not 0 for blocks without a border, see `interior`.

    Returns
    -------
    pairs : (N,) int
        k * count + m for regions k and m, both ways round; some repeatedly.
    links, cuts : (N,) int
        Edges that link the two, and those that a jump cuts, along a stretch of their border.
    """
    height, width = regions.shape
    # What the stretch at hand leads to: along a border most pixels lead where the one before does.
    other = np.zeros((2, count), np.intp)
    linked, cut = np.zeros((2, count), np.intp), np.zeros((2, count), np.intp)
    pairs, links, cuts = [0], [0], [0]
    found = pairs, links, cuts
    for told in found:
        told.clear()
    for i in range(height):
        within = inner[i // BLOCK]
        for j in range(width):
            k = int(regions[i, j])
            if k == 0 or within[j // BLOCK] > 0:
                continue
            for axis in range(2):
                if axis == 0:
                    m = int(regions[i, j + 1]) if j + 1 < width else k
                    touch = m != k and grid.right[i, j] > 0
                else:
                    m = int(regions[i + 1, j]) if i + 1 < height else k
                    touch = m != k and grid.below[i, j] > 0
                if m == k or min(k, m) == 0:
                    continue
                if other[axis, k] != m:
                    _append_run(k, other[axis, k], linked[axis, k], cut[axis, k], count, found)
                    other[axis, k], linked[axis, k], cut[axis, k] = m, 0, 0
                linked[axis, k] += touch
                cut[axis, k] += not touch
    for axis in range(2):
        for k in range(count):
            _append_run(k, other[axis, k], linked[axis, k], cut[axis, k], count, found)
    return np.array(pairs, np.intp), np.array(links, np.intp), np.array(cuts, np.intp)


@njit(cache=True, nogil=True)
def _append_run(
    k: int,
    m: int,
    linked: int,
    cut: int,
    count: int,
    found: tuple[list[int], list[int], list[int]],
) -> None:
    """Note a stretch of border between regions k and m, 0 for none, both ways round."""
    if m > 0:
        for pair in (k * count + m, m * count + k):
            found[0].append(pair)
            found[1].append(linked)
            found[2].append(cut)


def group_coplanar(fits: Fits, runs: BorderRuns) -> NDArray[np.intp]:
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
    runs : three (N,) int
        Of their borders, see `find_borders`.

    Returns
    -------
    (M + 1,) int
        Label of the largest region of the group; 0 where there is no plane.
    """
    edges, place = np.unique(runs[0], return_inverse=True)
    # Of no edges at all NumPy would count in integers, and another kernel be compiled for them.
    links = np.bincount(place, runs[1], len(edges)).astype(np.float64)
    balance = links - np.bincount(place, runs[2], len(edges))
    around = _around(fits, edges, balance, fits.sensor.agreement)
    limits = np.where(balance >= 0, _TOUCHING_LIMIT, np.where(links > 0, _LIMIT, 0.0))
    regions = len(fits.theta)
    start = np.searchsorted(edges, np.arange(regions + 1) * regions)
    return _groups_of_touching(_by_falling_size(fits), fits, edges, start, limits, around)


@njit(cache=True)
def _around(
    fits: Fits, edges: NDArray[np.intp], balance: NDArray[Any], agreement: float
) -> NDArray[np.intp]:
    """Region (M + 1,) that each lies in, neither before nor behind it; 0 for none."""
    count = len(fits.theta)
    result = np.zeros(count, np.intp)
    for e in range(len(edges)):
        inner, outer = edges[e] // count, edges[e] % count
        # Two planes meet along a line, and a line is never more than half of an outline.
        if 2 * balance[e] <= fits.cells.border[inner]:
            continue
        theta, sums = fits.theta[outer], fits.explained[inner]
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
            result[inner] = outer
    return result


def _by_falling_size(fits: Fits) -> NDArray[np.intp]:
    order = np.argsort(-fits.pixels, kind='stable')
    return order[np.any(fits.theta[order] != 0, axis=1)]


@njit(cache=True, nogil=True)
def _groups(order: NDArray[np.intp], fits: Fits) -> NDArray[np.intp]:
    surface = np.zeros(len(fits.theta), np.intp)
    for rank in range(len(order)):
        k = order[rank]
        surface[k] = k
        least = _LIMIT
        for m in order[:rank]:
            if surface[m] == m:
                value = _difference(fits, k, m, _LIMIT)
                if value < least:
                    least, surface[k] = value, m
    return surface


@njit(cache=True, nogil=True)
def _groups_of_touching(
    order: NDArray[np.intp],
    fits: Fits,
    edges: NDArray[np.intp],
    start: NDArray[np.intp],
    limits: NDArray[np.float64],
    around: NDArray[np.intp],
) -> NDArray[np.intp]:
    count = len(fits.theta)
    group = np.zeros(count, np.intp)
    for k in order:
        # 0 while the region around, then the smaller one, has had no turn.
        group[k] = group[around[k]]
        if group[k] > 0:
            continue
        group[k] = k
        least = _TOUCHING_LIMIT
        for e in range(start[k], start[k + 1]):
            # 0 while the region at the other end, smaller, has had no turn.
            leader = group[edges[e] % count]
            if leader > 0 and leader != k:
                value = _difference(fits, k, leader, limits[e])
                if value < min(least, limits[e]):
                    least, group[k] = value, leader
    return group


@njit(cache=True)
def _difference(fits: Fits, k: int, m: int, limit: float) -> float:
    """Chi-squared of the difference of two planes; above `limit` it is only known to be."""
    apart = fits.theta[k] - fits.theta[m]
    both = fits.covariance[k] + fits.covariance[m]
    value = _chi_squared(apart, both)
    if value > limit:
        return value
    common = np.zeros((3, 3))
    for a in fits.parts[fits.start[k] : fits.start[k + 1]]:
        for b in fits.parts[fits.start[m] : fits.start[m + 1]]:
            common += pairs(fits.cells, a, fits.theta[k], b, fits.theta[m], fits.systematic)
    common = _product(_product(fits.inverse[k], common), fits.inverse[m])
    return _chi_squared(apart, both - common - common.T)


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
    aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
    if determinant <= 0:
        return np.inf
    p, q, r = difference[0], difference[1], difference[2]
    square = aa * p * p + dd * q * q + ff * r * r
    return (square + 2 * (bb * p * q + cc * p * r + ee * q * r)) / determinant
