"""The sensor model measured in one image, from the residuals of planes in nested blocks.

V(s) is the mean square residual within blocks of s pixels, M(s) what one plane through four of
them leaves beyond the planes of the four, for each of its nine degrees of freedom; what noise and
distortion make of them is in docs/method.md.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np

from rangeseg_ros.core.arrays import Floats, Indices, Singles
from rangeseg_ros.core.fitting.error_law import Law, Strata, fit_law
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks, sum_of_four
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import (
    FLOOR,
    SensorModel,
    correlated_residuals,
    systematic_variance,
)
from rangeseg_ros.core.significance import CLEARLY, OUTLIER, SAMPLES, chi2_quantile, quantile

ROUGH = chi2_quantile(13) / 13
"""Chi-squared of 13 degrees of freedom over its mean: what is rougher is no part of a plane."""
# Chi-squared of 9 degrees of freedom, of what one plane through four blocks leaves, over its mean:
# what is rougher is no part of a plane, and the median.
_BENT = chi2_quantile(9) / 9
_MEDIAN = chi2_quantile(9, 0.5) / 9
# Most blocks lie on planes, but edges and curvature only ever add to the residuals.
_QUANTILE = 0.4
# Blocks of a scale that tell the kind of the noise, about: a quantile of two hundred in each
# stratum is off by 3 % of a standard deviation. With half of them clutter decides, in one image of
# five, whether a sensor errs in disparity or in range; with 3000 in none of ten.
_MOST = 4800
# Blocks that tell how much noise of a known kind there is.
_ENOUGH = 2400
# Errors that simulated images without noise are taken to have, 1/m: 0.4 mm at 2 m, less than
# sensors have but more than what sums of float32 over windows do.
_EXACT = 1e-4
# Largest blocks, pixels: about as wide as distortions look. Most of larger ones hold a corner.
_WIDEST = 8 * BLOCK
# Widths of kernels that are told apart, pixels.
_WIDTHS = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
# Rows that tell the quantisation, and the quantile of their steps that is one quantum if any is.
_ROWS, _SMALLEST = 20, 0.1
# Pairs of neighbours that are not the same, at least: a quantile of fewer says nothing.
_PAIRS = 40
# Steps that are no jump, as share of the range: that of a Kinect is 2 % at 8 m.
_COARSEST = 0.05
# Pairs of neighbours that rounding makes the same, for each that it does not, at least.
_SAME = 0.05


def nested(image: RangeImage) -> list[Blocks]:
    """Blocks of 4, 8, 16, ... pixels of an image."""
    scales, side = [Blocks.of(image)], BLOCK
    while side < _WIDEST:
        side *= 2
        scales.append(scales[-1].merged(image.rays, side))
    return scales


def measured_sensor(
    scales: list[Blocks], prior: SensorModel, quanta: tuple[float, float]
) -> SensorModel:
    """The errors that an image shows in its `nested` blocks; the `prior` where it says too little.

    `quanta` are the steps that it is rounded to, see `quantisation`.
    """
    # Not scales[0]: blocks that round to a single value hide the noise, and in small blocks noise
    # alone makes slopes.
    coarse = scales[1]
    count = coarse.moments[..., COUNT]
    used = np.flatnonzero(2 * count >= count.max())
    if len(used) < SAMPLES:
        return prior
    quantum, range_quantum = quanta
    # Rounding errors spread evenly over a step.
    rounding = max(quantum / np.sqrt(12), _EXACT)
    range_rounding = range_quantum / np.sqrt(12)
    least = Law(rounding**2, range_rounding**2)
    used = _thinned(used, _MOST)
    freedom = np.maximum(count - 3, 1)
    mean_square = coarse.residual / (freedom * _quantile_over_mean(_median(freedom, used)))

    strata = Strata.of(coarse, used)
    shown = quantile(mean_square.ravel()[strata.blocks], _QUANTILE)
    shown = np.maximum(shown, least.facing(strata.squared))
    noise = fit_law(strata, shown, np.zeros(len(shown)), Law(1.0, 0.0))
    found = _over_scales(scales, noise, least, prior)
    if found is None:
        return prior
    within, between, filled, distortion, unbent = found
    total, white, width = _split(within, between, filled)
    # Blocks hide a part of the noise, and never show more than there is.
    return prior._replace(
        noise=max(float(np.sqrt(noise.constant * total)), rounding),
        range_noise=max(float(np.sqrt(noise.quartic * total)), range_rounding),
        direction_noise=float(np.sqrt(noise.tilt * total)),
        white=white,
        correlation=width,
        distortion=max(float(np.sqrt(distortion.constant)), rounding),
        range_distortion=max(float(np.sqrt(distortion.quartic)), range_rounding),
        unbent=unbent,
        quantum=quantum,
        range_quantum=range_quantum,
        noise_error=noise.error,
        distortion_error=distortion.error,
    )


def _over_scales(
    scales: list[Blocks], noise: Law, least: Law, prior: SensorModel
) -> tuple[list[float], float, float, Law, float] | None:
    """What blocks of 4, 8, 16, ... pixels show, as long as there are enough of them.

    V(4), V(8), ... over `noise`, the law of 8 pixels, and M(8) over it; the share of pixels
    measured in most blocks; the law of the largest distortion of all scales; the share of its
    variance in the smallest blocks. None where too few blocks are flat. `least` is the lowest
    noise. Blocks that bend by more than the `prior` allows are taken for several surfaces.
    """
    blocks = scales[0]
    level = noise.variances(scales[1]).repeat(2, axis=0).repeat(2, axis=1)
    level = level[: len(blocks.squared), : blocks.squared.shape[1]]
    count = blocks.moments[..., COUNT]
    # Six pixels leave three degrees of freedom.
    flat = (count >= 6) & (blocks.residual < ROUGH * level * np.maximum(count - 3, 1))
    if not flat.any():
        return None
    used = _thinned(np.flatnonzero(flat), _ENOUGH)
    strata = Strata.of(blocks, used)
    within = [_ratio(blocks, level, used, strata)]
    # What is new in every pixel shows in the smallest blocks, but for what numbers are rounded by.
    shown = noise.times(within[0])
    shown = shown._replace(constant=max(shown.constant, least.constant))
    between, filled, distortion, typical = 1.0, 1.0, Law(0.0, 0.0), list[float]()
    bend, ranges = noise, strata.squared
    for blocks, larger in pairwise(scales):
        whole = sum_of_four(flat) == 4
        used = np.flatnonzero(whole)
        if len(used) < SAMPLES:
            break
        used = _thinned(used, _ENOUGH)
        strata = Strata.of(larger, used)
        level = sum_of_four(level) / 4
        excess = np.maximum(larger.residual - sum_of_four(blocks.residual), 0) / (9 * _MEDIAN)
        if len(within) < 3:  # what `_split` takes
            within.append(_ratio(larger, level, used, strata))
        pixels = _median(larger.moments[..., COUNT], used) / 4
        if larger is scales[1]:
            between = float(strata.medians(excess / level).mean())
            filled = pixels / BLOCK**2
        expected = shown.variances(larger)
        bent = np.maximum(strata.medians(excess), FLOOR)
        bend = fit_law(strata, bent, strata.medians(expected), bend)
        # M(s) = v + D^2 n / 8, with n pixels in each of the four.
        typical.append(8 / pixels * float(quantile(bend.facing(ranges), 0.5)))
        if typical[-1] == max(typical):
            distortion = bend.times(8 / pixels)
        # Keep what bends by at most four standard deviations of the prior's distortion. A lower
        # limit would keep only the flattest blocks, and their distortion would be too small.
        allowed = OUTLIER**2 * systematic_variance(prior, larger.squared) * pixels / 8
        flat = whole & (excess < _BENT * (expected + allowed))
    if not typical:
        return None
    lowest = float(quantile(least.facing(ranges), 0.5))
    unbent = max(typical[0], lowest) / max(*typical, lowest)
    # A smaller difference may be chance.
    return within, between, filled, distortion, unbent if CLEARLY * unbent < 1 else 1.0


def _thinned(used: Indices, most: int) -> Indices:
    """Every n-th of N numbers: about as many as `most`."""
    # Odd, as rows of blocks are rarely odd: not the same columns of every row.
    return used[:: max(len(used) // most, 1) | 1]


def _median(values: Floats, used: Indices) -> float:
    """Median of the values (rows, columns) of blocks of these flat indices (N,)."""
    return float(quantile(values.ravel()[used], 0.5))


def _ratio(blocks: Blocks, level: Floats, used: Indices, strata: Strata) -> float:
    """What blocks of these flat indices (N,) show of the variances `level` (rows, columns)."""
    freedom = np.maximum(blocks.moments[..., COUNT] - 3, 1)
    ratio = blocks.residual / (level * freedom)
    shown = quantile(ratio.ravel()[strata.blocks], _QUANTILE).mean()
    return float(shown) / _quantile_over_mean(_median(freedom, used))


@cache
def _quantile_over_mean(freedom: float) -> float:
    """Quantile of chi-squared of so many degrees of freedom over its mean."""
    return chi2_quantile(freedom, _QUANTILE) / freedom


def _split(within: list[float], between: float, filled: float) -> tuple[float, float, float]:
    """Total variance, white share and correlation length that explain V(4), V(8), V(16), M(8).

    By least squares relative to these, for each of some widths. Of a block only a share is
    `filled`: planes through these pixels miss the block's own by what sampling leaves of the
    residuals around it, as of a finite population, and count as many times less.
    """
    shown = np.maximum([*within, between], 1e-9)
    hidden = np.array([correlated_residuals(width) for width in _WIDTHS])
    apart = filled * hidden[:, 3] + (1 - filled) * hidden[:, 0]
    other = np.column_stack([hidden[:, : len(shown) - 1], apart]) / shown
    one = 1 / shown
    # Normal equations of white * one + correlated * other = 1, for each width.
    aa, ab, bb = one @ one, other @ one, (other * other).sum(axis=1)
    a, b = one.sum(), other.sum(axis=1)
    determinant = np.maximum(aa * bb - ab * ab, 1e-12 * aa * bb)
    white = (a * bb - b * ab) / determinant
    correlated = (b * aa - a * ab) / determinant
    # Where one of them would be negative, the other explains it alone.
    white, correlated = (
        np.where(correlated < 0, a / aa, np.maximum(white, 0)),
        np.where(white < 0, b / bb, np.maximum(correlated, 0)),
    )
    error = ((white[:, None] * one + correlated[:, None] * other - 1) ** 2).sum(axis=1)
    # The narrowest of those that fit alike: rounding is not to decide.
    best = int(np.argmax(np.isclose(error, error.min())))
    total = white[best] + correlated[best]
    return float(total), float(white[best] / total), _WIDTHS[best]


def quantisation(inverse: Singles) -> tuple[float, float]:
    """Steps of the inverse range, 1/m, and of the range, metres, that an image is rounded to.

    Of inverse ranges (H, W), 0 where nothing was measured. One of the steps at most is not 0.
    """
    rows = inverse[:: max(len(inverse) // _ROWS, 1)]
    both = (rows[:, 1:] > 0) & (rows[:, :-1] > 0)
    here, there = rows[:, 1:][both].astype(float), rows[:, :-1][both].astype(float)
    step = np.abs(here - there)
    unlike = (step > 0) & (step < _COARSEST * here)
    same, step = len(step) - np.count_nonzero(step), step[unlike]
    # Without rounding neighbours are hardly ever the same.
    if len(step) < _PAIRS or same < _SAME * len(step):
        return 0.0, 0.0
    quantum, clear = _common_step(step)
    range_quantum, range_clear = _common_step(step / (here[unlike] * there[unlike]))
    if max(clear, range_clear) < CLEARLY:
        return 0.0, 0.0
    return (quantum, 0.0) if clear > range_clear else (0.0, range_quantum)


def _common_step(steps: Floats) -> tuple[float, float]:
    """The step of which the smaller ones of these are multiples, and how clearly they are."""
    small = quantile(steps, _SMALLEST)
    # What was rounded twice is off by a little.
    near = steps[np.abs(steps - small) < 0.2 * small]
    others = int(np.count_nonzero(steps < 1.8 * small)) - len(near)
    return float(quantile(near, 0.5)), len(near) / max(others, 1)
