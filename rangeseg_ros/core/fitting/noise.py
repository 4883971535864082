r"""The sensor model measured in one image, from the residuals of planes in nested blocks.

Blocks of 4, 8, 16, ... pixels are nested, and what a plane through a block leaves is split as in
an analysis of variance: V(s) is the mean square residual within blocks of s pixels, M(s) what one
plane through four of them leaves beyond the planes of the four, for each of its nine degrees of
freedom. White noise of variance v has V = M = v at every scale. Noise correlated over some pixels
is hidden from blocks smaller than that, and M(s) rises above V. A smooth distortion bends large
blocks: M(s) grows with their area, the faster the stronger it is.

Where surfaces end, bend or meet, residuals are larger, never smaller: hence low quantiles, and
only blocks whose four parts are flat themselves are compared, scale by scale.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import gammaincinv

from rangeseg_ros.core.fitting.alike import Sets, alike, median, quantiles
from rangeseg_ros.core.fitting.quantisation import quantisation
from rangeseg_ros.core.runtime.threads import submit
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks, quad_sums, quads
from rangeseg_ros.core.sensing.moments import COUNT, SIZE
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import (
    FLOOR,
    SensorModel,
    correlated_residuals,
)

# Most blocks lie on planes, but edges and curvature only ever add to the residuals.
_QUANTILE = 0.4
# Blocks of a scale that weigh as much as what is known beforehand.
_PRIOR = 12
ROUGH = 2.7
"""Chi-squared of 13 degrees of freedom over its mean, quantile 0.999: what is rougher is no part
of a plane."""
# The same with 9 degrees of freedom, of what one plane through four blocks leaves.
_BENT = 3.1
# Blocks of a scale that are looked at, about: a quantile of fifty in each of `alike`'s sets is off
# by 6 % of a standard deviation, and the mean of these by little more than 1 %.
_MOST = 1200
# Share of the pixels of the fullest block that a block needs to count.
_SHARE = 0.5
# Rounds of least squares that settle the weights.
_ROUNDS = 5
# Errors that simulated images without noise are taken to have, 1/m: 0.4 mm at 2 m, less than
# sensors have but more than what sums of float32 over windows do.
_EXACT = 1e-4
# Median of chi-squared of 9 degrees of freedom over its mean.
_MEDIAN = 0.927
# Half of the likelihood ratio that is no chance, for one block: quantile 0.999 of chi-squared with
# one degree of freedom times the relative variance of a median of chi-squared with nine.
_CHANCE = 10.83 / 2 * (np.pi / 2) * (2 / 9)
# Widths of kernels that are told apart, pixels.
_WIDTHS = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0)


class Errors(NamedTuple):
    """A variance constant + quartic y^4 + tilt t at the inverse range y and squared slope t."""

    constant: float
    quartic: float
    tilt: float

    def at(self, squared: NDArray[np.float64], slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variances where the squares of inverse range and slope are these."""
        return FLOOR + self.constant + self.quartic * squared**2 + self.tilt * slope

    def times(self, factor: float) -> Errors:
        """So many times the variance."""
        return Errors(factor * self.constant, factor * self.quartic, factor * self.tilt)


class _Scale(NamedTuple):
    """Blocks of a scale that count, as many as it takes.

    Attributes
    ----------
    place : (N,) int
        Their numbers among all blocks of the scale.
    squared, slope : (N,) float64
        As of `Blocks`.
    sets : Sets
        Of these N.
    """

    place: NDArray[np.intp]
    squared: NDArray[np.float64]
    slope: NDArray[np.float64]
    sets: Sets

    @classmethod
    def of(cls, blocks: Blocks, used: NDArray[np.bool_]) -> _Scale:
        place = np.flatnonzero(used)
        place = place[:: max(len(place) // _MOST, 1)]
        squared, slope = blocks.squared.ravel()[place], blocks.slope.ravel()[place]
        return cls(place, squared, slope, alike(squared, slope))

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

    def errors(
        self,
        variance: NDArray[np.float64],
        quantile: float,
        kinds: tuple[int, ...],
        least: Errors,
        known: Errors,
    ) -> Errors:
        """What explains the `variance` of most blocks.

        At `least` so much there is, and of this so much is `known` and not asked for.
        """
        squared, tilt = (quantiles(term, self.sets, 0.5) for term in (self.squared, self.slope))
        shown = quantiles(variance, self.sets, quantile)
        shown = np.maximum(shown, least.at(squared, tilt))
        there = known.at(squared, tilt) - FLOOR
        blocks = len(self.place) / len(shown)
        # What faces the sensor first: noise makes slopes of its own, that would explain it.
        # Indices and no slice: kernels are compiled for layouts, and a slice's follows the size.
        facing = np.arange(0, len(shown), self.sets.slopes)
        terms = np.ones(len(squared)), squared**2
        # A sensor errs in disparity or in range: of both together a few blocks tell nothing.
        likeliest = [
            (*_likeliest(terms[kind][facing], shown[facing], there[facing], blocks), kind)
            for kind in kinds
        ]
        factor, _, kind = min(likeliest, key=lambda found: found[1])
        constant, quartic = (factor, 0.0) if kind == 0 else (0.0, factor)
        there += constant + quartic * terms[1]
        straight, _ = _likeliest(tilt, shown, there, blocks)
        return Errors(constant, quartic, straight)


def measured_sensor(image: RangeImage, blocks: Blocks, prior: SensorModel) -> SensorModel:
    """The errors that an image shows.

    Parameters
    ----------
    image : RangeImage
    blocks : Blocks
        Of the image.
    prior : SensorModel
        Taken as far as the image says too little.
    """
    quanta = submit(quantisation, image.inverse)
    # Smaller blocks would not do: rounding hides in those that it rounds alike, and noise makes
    # slopes of its own.
    coarse = Blocks.planes(quads(blocks.moments), image.rays, 2 * BLOCK)
    count = coarse.moments[..., COUNT]
    used = count >= _SHARE * count.max(initial=0)
    if np.count_nonzero(used) < _PRIOR:
        return prior
    scale = _Scale.of(coarse, used)
    quantum, range_quantum = quanta.result()
    # Rounding errors spread evenly over a step.
    rounding = max(quantum / np.sqrt(12), _EXACT)
    range_rounding = range_quantum / np.sqrt(12)
    none, rounded = Errors(0.0, 0.0, 0.0), Errors(rounding**2, range_rounding**2, 0.0)
    variance = scale.variance_ratio(coarse, 1.0)
    noise = scale.errors(variance, _QUANTILE, (0, 1), rounded, none)
    level, flat = _flat_blocks(blocks, noise.at(coarse.squared, coarse.slope))
    if not flat.any():
        return prior
    scale = _Scale.of(blocks, flat)
    within = [scale.mean(scale.variance_ratio(blocks, level), _QUANTILE)]
    between = filled = 1.0
    distortion = none
    # What is new in every pixel shows in the smallest blocks.
    shown = noise.times(within[0])
    # Lasers err in range alone.
    kinds = (0, 1) if noise.quartic > 0 else (0,)
    side, parts = BLOCK, blocks
    while True:
        whole = quad_sums(flat.astype(np.float64)) == 4
        if np.count_nonzero(whole) < _PRIOR:
            break
        apart, level = quad_sums(parts.residual), quad_sums(level) / 4
        parts = (
            coarse if side == BLOCK else Blocks.planes(quads(parts.moments), image.rays, 2 * side)
        )
        scale = _Scale.of(parts, whole)
        excess = np.maximum(parts.residual - apart, 0) / (9 * _MEDIAN)
        bending = scale.errors(excess.ravel()[scale.place], 0.5, kinds, none, shown)
        within.append(scale.mean(scale.variance_ratio(parts, level), _QUANTILE))
        # Measured in each of the four blocks: s^2 where there are no holes.
        pixels = median(scale.pixels(parts)) / 4
        if side == BLOCK:
            between = scale.mean((excess / level).ravel()[scale.place], 0.5)
            filled = pixels / side**2
        # M(s) = v + D^2 n / 8, with n pixels in a block. What grows with the slope are creases.
        smooth = bending.times(8 / pixels)._replace(tilt=0.0)
        expected = shown.at(parts.squared, parts.slope) + bending.at(parts.squared, parts.slope)
        flat = whole & (excess < _BENT * expected)
        typical = [
            median(errors.at(scale.squared, scale.slope)) for errors in (distortion, smooth)
        ]
        if typical[1] > typical[0]:
            distortion = smooth
        side = 2 * side
    if len(within) == 1:
        return prior
    total, white, width = _random(within, between, filled)
    # Blocks hide a part of the noise, and never show more than there is.
    return prior._replace(
        noise=max(float(np.sqrt(noise.constant * total)), rounding),
        range_noise=max(float(np.sqrt(noise.quartic * total)), range_rounding),
        pixel_noise=float(np.sqrt(noise.tilt * total)),
        white=white,
        correlation=width,
        distortion=max(float(np.sqrt(distortion.constant)), rounding),
        range_distortion=max(float(np.sqrt(distortion.quartic)), range_rounding),
        quantum=quantum,
        range_quantum=range_quantum,
    )


@njit(cache=True)
def _flat_blocks(
    blocks: Blocks, variance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Variances of blocks (rows, columns) from those of blocks of four, and which they explain."""
    rows, columns = blocks.squared.shape
    level, flat = np.empty((rows, columns)), np.empty((rows, columns), np.bool_)
    for i in range(rows):
        for j in range(columns):
            level[i, j] = variance[i // 2, j // 2]
            count = blocks.moments[i, j, COUNT]
            # Six pixels leave three degrees of freedom.
            limit = ROUGH * level[i, j] * max(count - 3, 1.0)
            flat[i, j] = (count >= 6) & (blocks.residual[i, j] < limit)
    return level, flat


@cache
def _share(freedom: float) -> float:
    """Quantile of chi-squared of so many degrees of freedom over its mean."""
    return 2 * float(gammaincinv(freedom / 2, _QUANTILE)) / freedom


@njit(cache=True)
def _likeliest(
    term: NDArray[np.float64],
    variances: NDArray[np.float64],
    known: NDArray[np.float64],
    blocks: float,
) -> tuple[float, float]:
    """Factor >= 0 of a term (N,) that with what is `known` explains variances (N,).

    Variances are spread in proportion to themselves (chi-squared): the likeliest factor is that of
    least squares weighted by what it explains, found in a few rounds. It is 0 where what is known
    explains medians of so many blocks as well. Also returns how unlikely it is, the deviance but
    for a constant.
    """
    explained = np.full(len(variances), np.mean(variances))
    factor = 0.0
    for _ in range(_ROUNDS):
        weight = term / explained**2
        factor = max((weight * (variances - known)).sum(), 0.0)
        factor /= max((weight * term).sum(), 1e-300)
        explained = np.maximum(known + factor * term, 1e-3 * variances)
    unlikely = (np.log(explained) + variances / explained).sum()
    if known.min() > 0:
        without = (np.log(known) + variances / known).sum()
        if without - unlikely < _CHANCE / blocks:
            return 0.0, without
    return factor, unlikely


def _random(within: list[float], between: float, filled: float) -> tuple[float, float, float]:
    """Total variance, white share and correlation length that explain V(4), V(8), V(16), M(4).

    M rises with the number of pixels that agree: with the share of a block that is `filled`.
    """
    shown = np.maximum(np.array([*within[:3], between]), 1e-9)
    best = np.inf
    result = 1.0, 1.0, 0.0
    for width in _WIDTHS:
        hidden = correlated_residuals(width)
        predicted = np.array([*hidden[: len(shown) - 1], 1 + filled * (hidden[3] - 1)])
        white, correlated, error = _white_and_correlated(predicted, shown)
        if error < best:
            best, total = error, white + correlated
            result = total, white / total, width
    return result


@njit(cache=True)
def _white_and_correlated(
    predicted: NDArray[np.float64], shown: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Variances >= 0 of white noise and of noise that shows as `predicted`, and their error.

    Of the sum of both, relative to what was `shown`, by least squares.
    """
    one, other = 1 / shown, predicted / shown
    aa, ab, bb = (one * one).sum(), (one * other).sum(), (other * other).sum()
    a, b = one.sum(), other.sum()
    determinant = aa * bb - ab * ab
    white, correlated = 0.0, b / bb
    if determinant > 1e-12 * aa * bb:
        white, correlated = (a * bb - b * ab) / determinant, (b * aa - a * ab) / determinant
    # Where one of them would be negative, the other explains it alone, and better than the sum
    # would with the negative one left out.
    if correlated < 0:
        white, correlated = a / aa, 0.0
    elif white < 0:
        white, correlated = 0.0, b / bb
    error = (white * one + correlated * other - 1) ** 2
    return white, correlated, error.sum()
