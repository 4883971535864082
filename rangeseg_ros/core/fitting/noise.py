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

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.alike import median
from rangeseg_ros.core.fitting.errors import BOTH, Errors, by_turn, explaining, turning, variances
from rangeseg_ros.core.fitting.quantisation import quantisation
from rangeseg_ros.core.fitting.scale import ENOUGH, MOST, QUANTILE, Scale
from rangeseg_ros.core.runtime.threads import submit
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, correlated_residuals
from rangeseg_ros.core.significance import SAMPLES, chi2_quantile

ROUGH = chi2_quantile(13) / 13
"""Chi-squared of 13 degrees of freedom over its mean: what is rougher is no part of a plane."""
# The same with 9 degrees of freedom, of what one plane through four blocks leaves.
_BENT = chi2_quantile(9) / 9
# Errors that simulated images without noise are taken to have, 1/m: 0.4 mm at 2 m, less than
# sensors have but more than what sums of float32 over windows do.
_EXACT = 1e-4
# Median of chi-squared of 9 degrees of freedom over its mean.
_MEDIAN = chi2_quantile(9, 0.5) / 9
# Widths of kernels that are told apart, pixels.
_WIDTHS = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0)


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
    coarse = blocks.merged(image.rays, 2 * BLOCK)
    count = coarse.moments[..., COUNT]
    used = 2 * count >= count.max(initial=0)
    if np.count_nonzero(used) < SAMPLES:
        return prior
    scale = Scale.of(coarse, used, BOTH, MOST)
    variance = scale.variance_ratio(coarse, 1.0)
    slopes = coarse.across.ravel()[scale.place], coarse.down.ravel()[scale.place]
    sets = submit(by_turn, scale.squared, *slopes, variance, QUANTILE)
    quantum, range_quantum = quanta.result()
    # Rounding errors spread evenly over a step.
    rounding = max(quantum / np.sqrt(12), _EXACT)
    range_rounding = range_quantum / np.sqrt(12)
    none, rounded = Errors(0.0, 0.0, 0.0), Errors(rounding**2, range_rounding**2, 0.0)
    noise = explaining(scale, variance, QUANTILE, True, rounded, none)
    each = len(variance) / len(sets.result().variance)
    tilt, way = turning(sets.result(), each, noise, rounded)
    noise = noise._replace(tilt=tilt)
    level, flat = _flat_blocks(blocks, variances(noise, coarse.squared, coarse.slope(way)))
    if not flat.any():
        return prior
    smallest = submit(_within, blocks, flat, way, level)
    within: list[float] = []
    between = filled = 1.0
    distortion = none
    # Lasers err in range alone.
    in_range = noise.quartic > 0
    side, parts = BLOCK, blocks
    while True:
        whole, apart, level = _of_four(flat, parts.residual, level)
        if np.count_nonzero(whole) < SAMPLES:
            break
        parts = coarse if side == BLOCK else parts.merged(image.rays, 2 * side)
        scale = Scale.of(parts, whole, way, ENOUGH)
        if side == BLOCK:
            # What is new in every pixel shows in the smallest blocks.
            within.append(smallest.result())
            shown = noise.times(within[0])
        excess = np.maximum(parts.residual - apart, 0) / (9 * _MEDIAN)
        bending = explaining(scale, excess.ravel()[scale.place], 0.5, in_range, none, shown)
        within.append(scale.mean(scale.variance_ratio(parts, level), QUANTILE))
        # Measured in each of the four blocks: s^2 where there are no holes.
        pixels = median(scale.pixels(parts)) / 4
        if side == BLOCK:
            between = scale.mean((excess / level).ravel()[scale.place], 0.5)
            filled = pixels / side**2
        # M(s) = v + D^2 n / 8, with n pixels in a block. What grows with the slope are creases.
        smooth = bending.times(8 / pixels)._replace(tilt=0.0)
        slope = parts.slope(way)
        expected = variances(shown, parts.squared, slope)
        expected += variances(bending, parts.squared, slope)
        flat = whole & (excess < _BENT * expected)
        typical = [
            median(variances(errors, scale.squared, scale.slope))
            for errors in (distortion, smooth)
        ]
        if typical[1] > typical[0]:
            distortion = smooth
        side = 2 * side
    if not within:
        return prior
    total, white, width = _random(within, between, filled)
    # Directions that err one way are those of a scanner that turns, anew in every pixel, so that
    # blocks hide nothing of it.
    turned = np.sqrt(noise.tilt * (total if way == BOTH else 1.0)) * np.array(way)
    # Blocks hide a part of the noise, and never show more than there is.
    return prior._replace(
        noise=max(float(np.sqrt(noise.constant * total)), rounding),
        range_noise=max(float(np.sqrt(noise.quartic * total)), range_rounding),
        column_noise=float(turned[0]),
        row_noise=float(turned[1]),
        white=white,
        correlation=width,
        distortion=max(float(np.sqrt(distortion.constant)), rounding),
        range_distortion=max(float(np.sqrt(distortion.quartic)), range_rounding),
        quantum=quantum,
        range_quantum=range_quantum,
    )


def _within(
    blocks: Blocks, flat: NDArray[np.bool_], way: tuple[float, float], level: NDArray[np.float64]
) -> float:
    """What the flat ones of the smallest blocks show of the variances `level`."""
    scale = Scale.of(blocks, flat, way, ENOUGH)
    return scale.mean(scale.variance_ratio(blocks, level), QUANTILE)


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _of_four(
    flat: NDArray[np.bool_], residual: NDArray[np.float64], level: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Of every 2 x 2 blocks (rows, columns): whether there are four, all of them flat; the sums
    of their residuals; a fourth of that of their variances `level`."""
    rows, columns = flat.shape
    shape = (rows + 1) // 2, (columns + 1) // 2
    count, apart, mean = np.zeros(shape, np.uint8), np.zeros(shape), np.zeros(shape)
    for i in range(rows):
        for j in range(columns):
            count[i // 2, j // 2] += flat[i, j]
            apart[i // 2, j // 2] += residual[i, j]
            mean[i // 2, j // 2] += level[i, j] / 4
    return count == 4, apart, mean


def _random(within: list[float], between: float, filled: float) -> tuple[float, float, float]:
    """Total variance, white share and correlation length that explain V(4), V(8), V(16), M(4).

    Of a block only a share is `filled`. Planes through these pixels miss the block's own by what
    sampling leaves of the residuals around it, as of a finite population; that and theirs count as
    many times less as there are fewer pixels.
    """
    shown = np.maximum(np.array([*within[:3], between]), 1e-9)
    best = np.inf
    result = 1.0, 1.0, 0.0
    for width in _WIDTHS:
        hidden = correlated_residuals(width)
        apart = filled * hidden[3] + (1 - filled) * hidden[0]
        predicted = np.array([*hidden[: len(shown) - 1], apart])
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
