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

from rangeseg_ros.core.fitting.alike import Sets
from rangeseg_ros.core.fitting.errors import BOTH, Errors, by_turn, explaining, turning, variances
from rangeseg_ros.core.fitting.nested import over_scales
from rangeseg_ros.core.fitting.quantisation import quantisation
from rangeseg_ros.core.fitting.scale import (
    ENOUGH,
    MOST,
    QUANTILE,
    Ratio,
    Scale,
    choose,
    every,
    mean_of_sets,
    scale_of,
    share,
    variance_ratio,
)
from rangeseg_ros.core.runtime.threads import submit
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks, slope_of
from rangeseg_ros.core.sensing.enlargement import Cells
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, correlated_residuals
from rangeseg_ros.core.significance import SAMPLES, chi2_quantile

ROUGH = chi2_quantile(13) / 13
"""Chi-squared of 13 degrees of freedom over its mean: what is rougher is no part of a plane."""
# Errors that simulated images without noise are taken to have, 1/m: 0.4 mm at 2 m, less than
# sensors have but more than what sums of float32 over windows do.
_EXACT = 1e-4
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
    found = _measured(image, blocks, prior) or prior
    few = image.inverse.size < ENOUGH * (2 * BLOCK) ** 2
    if found.white > 0.5 or found.correlation < 1 or few:
        return found
    # What is correlated over more than a pixel hides from blocks of four: every second pixel then.
    reduced = Cells(2, 0, 0).reduced(image)
    wider = _measured(reduced, Blocks.of(reduced), prior.every(2))
    return wider.every(0.5) if wider else found


def _measured(image: RangeImage, blocks: Blocks, prior: SensorModel) -> SensorModel | None:
    """The errors that blocks of an image show; None where these are too few."""
    # Smaller blocks would not do: rounding hides in those that it rounds alike, and noise makes
    # slopes of its own.
    coarse = blocks.merged(image.rays, 2 * BLOCK)
    quanta = submit(quantisation, image.inverse)
    used, place, squared, across, down = _telling(coarse)
    if used < SAMPLES:
        return None
    turns = submit(by_turn, squared, across, down)
    scale, ratio = _scale_and_ratio(coarse, place)
    variance = ratio.values / share(ratio.freedom)
    quantum, range_quantum = quanta.result()
    # Rounding errors spread evenly over a step.
    rounding = max(quantum / np.sqrt(12), _EXACT)
    range_rounding = range_quantum / np.sqrt(12)
    none, rounded = Errors(0.0, 0.0, 0.0), Errors(rounding**2, range_rounding**2, 0.0)
    noise = explaining(scale, variance, QUANTILE, True, rounded, none)
    tilt, way = turning(turns.result(), variance, QUANTILE, noise, rounded)
    noise = noise._replace(tilt=tilt)
    level, flat = _flat_blocks(blocks, coarse, noise, way)
    if not flat.any():
        return None
    smallest = submit(_within, blocks, flat, way, level)
    quantile, freedom = smallest.result()
    # What is new in every pixel shows in the smallest blocks, but for what numbers are rounded by.
    shown = noise.times(quantile / share(freedom))
    shown = shown._replace(constant=max(shown.constant, rounding**2))
    # Lasers err in range alone.
    ways = way, noise.quartic > 0
    nested = over_scales(flat, blocks.residual, level, coarse, image.rays, *ways, shown)
    if not len(nested.within):
        return None
    shares = [share(freedom), *(share(freedom) for freedom in nested.freedom)]
    within = list(np.array([quantile, *nested.within]) / shares)
    total, white, width = _random(within, nested.between, nested.filled)
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
        distortion=max(float(np.sqrt(nested.distortion.constant)), rounding),
        range_distortion=max(float(np.sqrt(nested.distortion.quartic)), range_rounding),
        quantum=quantum,
        range_quantum=range_quantum,
    )


@njit(cache=True, nogil=True)
def _telling(
    blocks: Blocks,
) -> tuple[int, NDArray[np.intp], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Those blocks of a scale that tell the kind of the noise.

    How many there are, and of those that are looked at the numbers (N,), the squared inverse
    ranges, and the squared slopes along the row and down the column.
    """
    count = blocks.moments[..., COUNT]
    rows, columns = count.shape
    most = 0.0
    for i in range(rows):
        for j in range(columns):
            most = max(most, count[i, j])
    used, found = np.empty((rows, columns), np.bool_), 0
    for i in range(rows):
        for j in range(columns):
            used[i, j] = 2 * count[i, j] >= most
            found += used[i, j]
    place = every(used, MOST)
    squared, across, down = np.empty(len(place)), np.empty(len(place)), np.empty(len(place))
    for k in range(len(place)):
        i, j = place[k] // columns, place[k] % columns
        squared[k] = blocks.squared[i, j]
        across[k], down[k] = blocks.across[i, j], blocks.down[i, j]
    return found, place, squared, across, down


def _scale_and_ratio(blocks: Blocks, place: NDArray[np.intp]) -> tuple[Scale, Ratio]:
    """The scale of blocks of such numbers (N,), and what they show of a variance of 1."""
    squared, slope, sets, ratio = _shown(blocks, place)
    return Scale(place, squared, slope, Sets(*sets)), Ratio(*ratio)


@njit(cache=True, nogil=True)
def _shown(
    blocks: Blocks, place: NDArray[np.intp]
) -> tuple[
    NDArray[np.float64],
    NDArray[np.float64],
    tuple[NDArray[np.int32], NDArray[np.intp], int],
    tuple[NDArray[np.float64], float],
]:
    """Fields of a `Scale`, of its `Sets` and of the `Ratio`."""
    scale = scale_of(blocks, place, BOTH)
    ratio = variance_ratio(scale, blocks, np.ones(blocks.squared.shape))
    order, start, slopes = scale.sets
    return scale.squared, scale.slope, (order, start, slopes), (ratio.values, ratio.freedom)


@njit(cache=True, nogil=True)
def _within(
    blocks: Blocks, flat: NDArray[np.bool_], way: tuple[float, float], level: NDArray[np.float64]
) -> tuple[float, float]:
    """What a quantile of the flat blocks shows of the variances `level`, and their freedom.

    See `Ratio`.
    """
    scale = choose(blocks, flat, way, ENOUGH)
    ratio = variance_ratio(scale, blocks, level)
    return mean_of_sets(scale, ratio.values, QUANTILE), ratio.freedom


@njit(cache=True, nogil=True)
def _flat_blocks(
    blocks: Blocks, coarse: Blocks, noise: Errors, way: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Variances of blocks (rows, columns), those of blocks of four, and which they explain."""
    rows, columns = blocks.squared.shape
    level, flat = np.empty((rows, columns)), np.empty((rows, columns), np.bool_)
    for i in range(rows):
        for j in range(columns):
            squared = coarse.squared[i // 2, j // 2]
            slope = slope_of(coarse, i // 2, j // 2, way)
            level[i, j] = variances(noise, squared, slope)
            count = blocks.moments[i, j, COUNT]
            # Six pixels leave three degrees of freedom.
            limit = ROUGH * level[i, j] * max(count - 3, 1.0)
            flat[i, j] = (count >= 6) & (blocks.residual[i, j] < limit)
    return level, flat


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
    white, correlated = 0.0, float(b / bb)
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
