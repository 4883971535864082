"""How the variance of a sensor's errors depends on range and slope, fitted to mean squares."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Indices
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.sensor import FLOOR
from rangeseg_ros.core.significance import chi2_quantile, f_quantile, quantile

# Strata of the inverse range, in each of the slope, and blocks of one at least: the error of a
# quantile of 40 blocks of 13 degrees of freedom is 7 % of a standard deviation.
_RANGES, _SLOPES, _PER_STRATUM = 8, 3, 40
# Rounds of least squares that settle the weights.
_ROUNDS = 5
# F with one and 22 degrees of freedom, those of the 24 strata of an image of VGA: slopes that
# explain more are no chance.
_SIGNIFICANT = f_quantile(1, 22)
# Median of the size of a normal error, in standard deviations.
_MEDIAN = chi2_quantile(1, 0.5) ** 0.5


class Law(NamedTuple):
    """Variance constant + quartic y^4 + tilt slope, at the inverse range y, (1/m)^2.

    The slope is the square of that from pixel to pixel.
    """

    constant: float
    quartic: float
    tilt: float = 0.0
    error: float = 0.0  # standard error of its deviations, as a share of these

    def facing(self, squared: Floats) -> Floats:
        """Variances at these squared inverse ranges, on surfaces that face the sensor."""
        return self.quartic * squared * squared + (FLOOR + self.constant)

    def variances(self, blocks: Blocks) -> Floats:
        """Variances (rows, columns) of the pixels of blocks."""
        return self.facing(blocks.squared) + self.tilt * blocks.slope

    def times(self, factor: float) -> Law:
        """So many times the variance."""
        variances = factor * self.constant, factor * self.quartic, factor * self.tilt
        return Law(*variances, self.error)


class Strata(NamedTuple):
    """Blocks alike in range and slope: of each range first those of the smallest slope."""

    blocks: Indices  # (S, N), flat indices of the blocks of each stratum
    squared: Floats  # (S,), medians of the squared inverse range
    slope: Floats  # (S,), of the slope
    slopes: int  # strata of a range

    @classmethod
    def of(cls, blocks: Blocks, used: Indices) -> Strata:
        """Strata of equal sizes of the blocks that are `used` (N,), but for a few left out."""
        squared, slope = blocks.squared.ravel()[used], blocks.slope.ravel()[used]
        slopes = _SLOPES if len(used) >= _SLOPES * _PER_STRATUM else 1
        ranges = min(_RANGES, max(len(used) // (slopes * _PER_STRATUM), 1))
        size = len(used) // (ranges * slopes)
        bounds = np.arange(1, ranges) * slopes * size
        order = np.argpartition(squared, bounds)[: ranges * slopes * size].reshape(ranges, -1)
        inner = np.argpartition(slope[order], np.arange(1, slopes) * size, axis=1)
        order = order[np.arange(ranges)[:, None], inner].reshape(-1, size)
        medians = quantile(squared[order], 0.5), quantile(slope[order], 0.5)
        return cls(used[order], *medians, slopes)

    def medians(self, values: Floats) -> Floats:
        """Median (S,) of the values of all blocks (rows, columns) in each stratum."""
        return quantile(values.ravel()[self.blocks], 0.5)


def fit_law(strata: Strata, shown: Floats, known: Floats, like: Law) -> Law:
    """Fit a law to variances (S,) `shown` by strata, of which `known` (S,) is explained already.

    The noise is constant in disparity or in range, whichever fits better: few blocks cannot tell
    a mixture, and one stratum cannot tell which (then as in `like`). It is fitted to the strata of
    least slope, as noise makes slopes of its own. Then a term in the slope is fitted to all
    strata, and kept if it is significant.
    """
    facing = np.arange(0, len(shown), strata.slopes)
    quartic = strata.squared[facing] ** 2
    ahead, before = shown[facing], known[facing]
    constant, deviance = _scale_term(np.ones(len(facing)), ahead, before)
    factor, other = _scale_term(quartic, ahead, before)
    in_range = other < deviance if len(facing) > 1 else like.quartic > 0
    law = Law(0.0, factor) if in_range else Law(constant, 0.0)
    known = known + law.facing(strata.squared)
    # Standard error from the scatter of the strata, by medians as clutter fills some. The relative
    # error of a deviation is half of that of a variance.
    ratio = shown / known
    spread = quantile(np.abs(ratio - quantile(ratio, 0.5)), 0.5) / _MEDIAN
    law = law._replace(error=float(spread / (2 * len(shown) ** 0.5)))
    tilt, deviance = _scale_term(strata.slope, shown, known)
    # F of the tilt. Edges leave more than chance: what is left of a perfect fit tells by how much
    # (quasi-likelihood; Wedderburn 1974). Two strata tell nothing.
    explained, left = _deviance(known, shown) - deviance, deviance - _deviance(shown, shown)
    significance = explained * max(len(shown) - 2, 0) / max(left, 1e-12)
    return law if significance < _SIGNIFICANT else law._replace(tilt=tilt)


@njit(cache=True, nogil=True)
def _scale_term(term: Floats, shown: Floats, known: Floats) -> tuple[float, float]:
    """Factor >= 0 of a term (S,) that with what is `known` explains variances (S,).

    Variances that are shown are spread in proportion to themselves (chi-squared): the likeliest
    factor is that of least squares weighted by what it explains, found in a few rounds. Also
    returns its deviance.
    """
    explained = np.full(len(shown), np.mean(shown))
    factor = 0.0
    for _ in range(_ROUNDS):
        weight = term / explained**2
        factor = max((weight * (shown - known)).sum(), 0.0)
        factor /= max((weight * term).sum(), 1e-300)
        explained = np.maximum(known + factor * term, 1e-3 * shown)
    return factor, _deviance(explained, shown)


@njit(cache=True, nogil=True)
def _deviance(explained: Floats, shown: Floats) -> float:
    """How unlikely variances (S,) are where such (S,) are expected, but for a constant."""
    return float((np.log(explained) + shown / explained).sum())
