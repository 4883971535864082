"""Blocks of one size as far as they tell the noise: which of them count, and what they show."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.alike import Sets, alike, median, quantiles
from rangeseg_ros.core.sensing.blocks import Blocks, slope_of
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.significance import chi2_quantile

QUANTILE = 0.4
"""Most blocks lie on planes, but edges and curvature only ever add to the residuals."""
MOST = 4800
"""Blocks of a scale that tell the kind of the noise, about: a quantile of two hundred in each of
`alike`'s sets is off by 3 % of a standard deviation. With half of them clutter decides, in one
image of five, whether a sensor errs in disparity or in range; with 3000 in none of ten."""
ENOUGH = 2400
"""Blocks that tell how much noise of a known kind there is: a quantile of a hundred in each of the
sets, and a mean over these."""


class Scale(NamedTuple):
    """Blocks of a scale that count, as many as it takes.

    Attributes
    ----------
    place : (N,) int
        Their numbers among all blocks of the scale.
    squared, slope : (N,) float64
        As of `Blocks`, the slope of the way in which directions err.
    sets : Sets
        Of these N.
    """

    place: NDArray[np.intp]
    squared: NDArray[np.float64]
    slope: NDArray[np.float64]
    sets: Sets


class Ratio(NamedTuple):
    """Mean square residuals of the blocks of a scale over variances, but for a common factor.

    Attributes
    ----------
    values : (N,) float64
        For each degree of freedom.
    freedom : float
        Of most of them. The `share` of that is the common factor: what a `QUANTILE` of the values
        is where the variances are right.
    """

    values: NDArray[np.float64]
    freedom: float


@njit(cache=True, nogil=True)
def choose(blocks: Blocks, used: NDArray[np.bool_], way: tuple[float, float], most: int) -> Scale:
    """Of the blocks `used` (rows, columns), every n-th: about as many as `most`."""
    return scale_of(blocks, every(used, most), way)


@njit(cache=True, nogil=True)
def every(used: NDArray[np.bool_], most: int) -> NDArray[np.intp]:
    """Numbers (N,) of every n-th of the blocks `used` (rows, columns): about as many as `most`."""
    rows, columns = used.shape
    count = 0
    for i in range(rows):
        for j in range(columns):
            count += used[i, j]
    # Odd, as rows of blocks are rarely odd: not the same columns of every row.
    stride = max(count // most, 1) | 1
    place = np.empty((count + stride - 1) // stride, np.intp)
    seen = k = 0
    for i in range(rows):
        for j in range(columns):
            if not used[i, j]:
                continue
            if seen % stride == 0:
                place[k] = i * columns + j
                k += 1
            seen += 1
    return place


@njit(cache=True, nogil=True)
def scale_of(blocks: Blocks, place: NDArray[np.intp], way: tuple[float, float]) -> Scale:
    """Scale of the blocks of such numbers (N,)."""
    columns = blocks.squared.shape[1]
    squared, slope = np.empty(len(place)), np.empty(len(place))
    for k in range(len(place)):
        i, j = place[k] // columns, place[k] % columns
        squared[k], slope[k] = blocks.squared[i, j], slope_of(blocks, i, j, way)
    return Scale(place, squared, slope, alike(squared, slope))


@njit(cache=True, nogil=True)
def pixels_of(scale: Scale, blocks: Blocks) -> NDArray[np.float64]:
    """Measured pixels (N,) of each."""
    columns = blocks.squared.shape[1]
    pixels = np.empty(len(scale.place))
    for k, place in enumerate(scale.place):
        pixels[k] = blocks.moments[place // columns, place % columns, COUNT]
    return pixels


@njit(cache=True, nogil=True)
def variance_ratio(scale: Scale, blocks: Blocks, level: NDArray[np.float64]) -> Ratio:
    """What blocks show of the variances `level` (rows, columns)."""
    columns = blocks.squared.shape[1]
    freedom = pixels_of(scale, blocks)
    values = np.empty(len(freedom))
    for k, place in enumerate(scale.place):
        freedom[k] = max(freedom[k] - 3, 1.0)
        i, j = place // columns, place % columns
        values[k] = blocks.residual[i, j] / level[i, j] / freedom[k]
    return Ratio(values, median(freedom))


@njit(cache=True, nogil=True)
def mean_of_sets(scale: Scale, values: NDArray[np.float64], quantile: float) -> float:
    """Mean over the sets of a quantile of the values (N,) of their blocks."""
    return float(quantiles(values, scale.sets, quantile).mean())


@cache
def share(freedom: float) -> float:
    """Quantile of chi-squared of so many degrees of freedom over its mean."""
    return chi2_quantile(freedom, QUANTILE) / freedom
