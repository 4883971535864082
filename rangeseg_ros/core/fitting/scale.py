"""Blocks of one size as far as they tell the noise: which of them count, and what they show."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.alike import Sets, alike, median, quantiles
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.moments import COUNT, SIZE
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

    @classmethod
    def of(
        cls, blocks: Blocks, used: NDArray[np.bool_], way: tuple[float, float], most: int
    ) -> Scale:
        """Of the blocks `used` (rows, columns), every n-th: about as many as `most`."""
        return cls(*_chosen(blocks.squared, blocks.across, blocks.down, used, way, most))

    def pixels(self, blocks: Blocks) -> NDArray[np.float64]:
        """Measured pixels (N,) of each."""
        pixels: NDArray[np.float64] = blocks.moments.reshape(-1, SIZE)[self.place, COUNT]
        return pixels

    def variance_ratio(
        self, blocks: Blocks, level: NDArray[np.float64] | float
    ) -> NDArray[np.float64]:
        """Mean square residuals (N,) of what the quantile of those of a variance `level` is."""
        freedom = np.maximum(self.pixels(blocks) - 3, 1)
        ratio = blocks.residual.ravel()[self.place]
        ratio /= level if isinstance(level, float) else level.ravel()[self.place]
        return ratio / (freedom * _share(median(freedom)))

    def mean(self, ratio: NDArray[np.float64], quantile: float) -> float:
        """Mean over the sets of a quantile of what their blocks show of what was expected."""
        return float(np.mean(quantiles(ratio, self.sets, quantile)))


@njit(cache=True, nogil=True)
def _chosen(
    squared: NDArray[np.float64],
    across: NDArray[np.float64],
    down: NDArray[np.float64],
    used: NDArray[np.bool_],
    way: tuple[float, float],
    most: int,
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64], Sets]:
    """The attributes of a `Scale`."""
    rows, columns = used.shape
    count = 0
    for i in range(rows):
        for j in range(columns):
            count += used[i, j]
    # Odd, as rows of blocks are rarely odd: not the same columns of every row.
    stride = max(count // most, 1) | 1
    count = (count + stride - 1) // stride
    place = np.empty(count, np.intp)
    levels, slopes = np.empty(count), np.empty(count)
    seen = k = 0
    for i in range(rows):
        for j in range(columns):
            if not used[i, j]:
                continue
            if seen % stride == 0:
                place[k], levels[k] = i * columns + j, squared[i, j]
                slopes[k] = way[0] * across[i, j] + way[1] * down[i, j]
                k += 1
            seen += 1
    return place, levels, slopes, alike(levels, slopes)


@cache
def _share(freedom: float) -> float:
    """Quantile of chi-squared of so many degrees of freedom over its mean."""
    return chi2_quantile(freedom, QUANTILE) / freedom
