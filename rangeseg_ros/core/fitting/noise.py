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

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import chi2

from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks, quads
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import (
    FLOOR,
    SensorModel,
    correlated_residuals,
    random_variance,
)

# Bins of the inverse range with enough blocks for a quantile each: the error of a quantile of 40
# blocks of 13 degrees of freedom is 7 % of a standard deviation.
_BINS, _SLOPES, _PER_BIN = 8, 3, 40
# Most blocks lie on planes, but edges and curvature only ever add to the residuals.
_QUANTILE = 0.4
# Blocks of a scale that weigh as much as what is known beforehand.
_PRIOR = 12
# Chi-squared of 13 and of 9 degrees of freedom over their mean, quantile 0.999: rougher blocks are
# no part of a plane.
_ROUGH, _BENT = 2.7, 3.1
# Rows that tell the quantisation by, and the quantile of steps that is one quantum where there is
# one.
_ROWS, _SMALLEST = 40, 0.1
# Steps of one quantum for each that is neither one nor two.
_CLEAR = 4.0
# Share of the pixels of the fullest block that a block needs to count.
_SHARE = 0.5
# Rounds of least squares that settle the weights.
_ROUNDS = 5
# Steps that are no jump, as share of the range: that of a Kinect is 2 % at 8 m.
_COARSEST = 0.05
# Pairs of neighbours that rounding makes the same, for each that it does not, at least.
_SAME = 0.05
# Errors that simulated images without noise are taken to have, 1/m: 0.4 mm at 2 m, less than
# sensors have but more than what sums of float32 over windows do.
_EXACT = 1e-4
# Median of chi-squared of 9 degrees of freedom over its mean.
_MEDIAN = 0.927
# Square of a slope that no surface has, 1/m^2.
_STEEPEST = 1e12
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

    @classmethod
    def explaining(
        cls,
        variance: NDArray[np.float64],
        squared: NDArray[np.float64],
        slope: NDArray[np.float64],
        quantile: float,
        kinds: tuple[int, ...],
        least: Errors,
        known: Errors,
    ) -> Errors | None:
        """What explains the `variance` of most of N blocks; None where they are too few.

        At `least` so much there is, and of this so much is `known` and not asked for.
        """
        if len(variance) < _PRIOR:
            return None
        terms, shown = [], []
        cells, slopes = _cells(squared, slope)
        for cell in cells:
            fourth, tilt = _ranked(squared[cell], 0.5) ** 2, _ranked(slope[cell], 0.5)
            value = _ranked(variance[cell], quantile)
            other = known.constant + known.quartic * fourth + known.tilt * tilt
            lowest = FLOOR + least.constant + least.quartic * fourth + least.tilt * tilt
            shown.append(max(value - other, lowest))
            terms.append((1.0, fourth, tilt))
        # What faces the sensor first: noise makes slopes of its own, that would explain it.
        table, level = np.array(terms), np.array(shown)
        facing, values = table[::slopes], level[::slopes]
        # A sensor errs in disparity or in range: of both together a few blocks tell nothing.
        likeliest = [(*_likeliest(facing[:, kind], values), kind) for kind in kinds]
        factor, _, kind = min(likeliest, key=lambda found: found[1])
        constant, quartic = (factor, 0.0) if kind == 0 else (0.0, factor)
        straight = constant + quartic * table[:, 1]
        tilt, _ = _likeliest(table[:, 2], level, straight)
        return cls(constant, quartic, tilt)


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
    quantum, range_quantum = _quantisation(image.inverse)
    # Rounding errors spread evenly over a step.
    rounding = max(quantum / np.sqrt(12), _EXACT)
    range_rounding = range_quantum / np.sqrt(12)
    # Smaller blocks would not do: rounding hides in those that it rounds alike, and noise makes
    # slopes of its own.
    coarse = Blocks.planes(quads(blocks.moments), image.rays, 2 * BLOCK)
    count = coarse.moments[..., COUNT]
    used = count >= _SHARE * count.max(initial=0)
    freedom = np.maximum(count - 3, 1)
    variance = coarse.residual[used] / freedom[used] / _expected(freedom[used])
    none, rounded = Errors(0.0, 0.0, 0.0), Errors(rounding**2, range_rounding**2, 0.0)
    noise = Errors.explaining(
        variance, coarse.squared[used], coarse.slope[used], _QUANTILE, (0, 1), rounded, none
    )
    if noise is None:
        return prior
    level = noise.at(coarse.squared, coarse.slope).repeat(2, axis=0).repeat(2, axis=1)
    level = level[: blocks.squared.shape[0], : blocks.squared.shape[1]]
    count = blocks.moments[..., COUNT]
    freedom = np.maximum(count - 3, 1)
    moments, residual = blocks.moments, blocks.residual
    # Six pixels leave three degrees of freedom.
    flat = (count >= 6) & (residual < _ROUGH * level * freedom)
    if not flat.any():
        return prior
    ratio = (residual / level / freedom)[flat] / _expected(freedom[flat])
    within = [_mean_ratio(ratio, blocks.squared[flat], blocks.slope[flat], _QUANTILE)]
    between = 1.0
    distortion = none
    # What is new in every pixel shows in the smallest blocks.
    shown = Errors(*(within[0] * np.array(noise)).tolist())
    # Lasers err in range alone.
    kinds = (0, 1) if noise.quartic > 0 else (0,)
    side = BLOCK
    while True:
        whole = _quad_sums(flat.astype(np.int8)) == 4
        parts = Blocks.planes(quads(moments), image.rays, 2 * side)
        level = _quad_sums(level) / 4
        excess = np.maximum(parts.residual - _quad_sums(residual), 0) / (9 * _MEDIAN)
        bending = Errors.explaining(
            excess[whole], parts.squared[whole], parts.slope[whole], 0.5, kinds, none, shown
        )
        if bending is None:
            break
        freedom = parts.moments[..., COUNT][whole] - 3
        ratio = (parts.residual / level)[whole] / freedom / _expected(freedom)
        alike = parts.squared[whole], parts.slope[whole]
        within.append(_mean_ratio(ratio, *alike, _QUANTILE))
        if side == BLOCK:
            between = _mean_ratio((excess / level)[whole], *alike, 0.5)
        # M(s) = v + D^2 s^2 / 8.
        smooth = Errors(*(8 / side**2 * np.array(bending)).tolist())
        expected = shown.at(parts.squared, parts.slope) + bending.at(parts.squared, parts.slope)
        flat = whole & (excess < _BENT * expected)
        typical = [
            float(np.median(errors.at(parts.squared[whole], parts.slope[whole])))
            for errors in (distortion, smooth)
        ]
        if typical[1] > typical[0]:
            distortion = smooth
        moments, residual, side = parts.moments, parts.residual, 2 * side
    if len(within) == 1:
        return prior
    total, white, width = _random(np.array(within[:3]), between)
    # Blocks hide a part of the noise, and never show more than there is.
    return prior._replace(
        noise=max(float(np.sqrt(noise.constant * total)), rounding),
        range_noise=max(float(np.sqrt(noise.quartic * total)), range_rounding),
        pixel_noise=float(np.sqrt(noise.tilt * total)),
        white=white,
        correlation=width,
        distortion=max(float(np.sqrt(distortion.constant)), rounding),
        range_distortion=max(float(np.sqrt(distortion.quartic)), range_rounding),
        pixel_distortion=float(np.sqrt(distortion.tilt)),
        quantum=quantum,
        range_quantum=range_quantum,
    )


def jump_steps(
    blocks: Blocks, sensor: SensorModel
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Smallest step of the inverse range that is a jump, and the slope of the surface.

    Second differences of means of 3 x 3 pixels, that jump edges are found by, have 0.72 times
    the variance of `agreement` for white and correlated noise alike (0.67 to 0.76), and five
    standard deviations are no noise. Rounding alone makes steps of one quantum, and of two
    where noise adds to it.

    Parameters
    ----------
    blocks : Blocks
        (rows, columns).
    sensor : SensorModel

    Returns
    -------
    steps : (rows, columns) float32
        1/m.
    slopes : (rows, columns) float32
        Change of the inverse range from pixel to pixel, 1/m; where a block is not flat, that of
        the flattest beside it.
    """
    factor = 25 * 0.72 * sensor.agreement
    level = random_variance(sensor, blocks.squared)
    # The slope of a block that a jump crosses is the jump's: its neighbours' then.
    count = blocks.moments[..., COUNT]
    bounded = level + sensor.pixel_noise**2 * blocks.slope
    flat = (count > 3) & (blocks.residual < _ROUGH * bounded * np.maximum(count - 3, 1))
    slope = np.where(flat, blocks.slope, _STEEPEST).astype(np.float32)
    least = cv2.erode(slope, np.ones((3, 3), np.uint8))
    slope = np.where(flat, slope, np.where(least < _STEEPEST, least, 0))
    rounding = np.maximum(sensor.quantum, sensor.range_quantum * blocks.squared)
    steps = np.sqrt(factor * (level + sensor.pixel_noise**2 * slope))
    steps = np.maximum(steps, 2.2 * rounding)
    return steps.astype(np.float32), np.sqrt(slope, dtype=np.float32)


def _cells(
    squared: NDArray[np.float64], slope: NDArray[np.float64]
) -> tuple[list[NDArray[np.intp]], int]:
    """Indices of N blocks alike in range and slope, and how many such sets there are of a range.

    Of each range, those that face the sensor come first.
    """
    slopes = _SLOPES if len(squared) >= _SLOPES * _PER_BIN else 1
    bins = min(_BINS, max(len(squared) // (slopes * _PER_BIN), 1))
    cells = []
    for part in np.array_split(np.argsort(squared, kind='stable'), bins):
        cells += np.array_split(part[np.argsort(slope[part], kind='stable')], slopes)
    return cells, slopes


def _expected(freedom: NDArray[np.float64]) -> float:
    """What the quantile of variances of so many degrees of freedom has of their mean."""
    typical = float(np.median(freedom))
    return float(chi2.ppf(_QUANTILE, typical)) / typical


def _ranked(values: NDArray[np.float64], quantile: float) -> float:
    """One of N values that so many lie below: np.quantile takes ten times as long for a few."""
    rank = int(quantile * (len(values) - 1))
    return float(np.partition(values, rank)[rank])


def _mean_ratio(
    ratio: NDArray[np.float64],
    squared: NDArray[np.float64],
    slope: NDArray[np.float64],
    quantile: float,
) -> float:
    """Mean over sets of like blocks of a quantile of what they show of what was expected."""
    cells, _ = _cells(squared, slope)
    return float(np.mean([_ranked(ratio[cell], quantile) for cell in cells]))


def _likeliest(
    term: NDArray[np.float64],
    variances: NDArray[np.float64],
    known: NDArray[np.float64] | float = 0,
) -> tuple[float, float]:
    """Factor >= 0 of a term (N,) that with what is `known` explains variances (N,).

    Variances are spread in proportion to themselves (chi-squared): the likeliest factor is that of
    least squares weighted by what it explains, found in a few rounds. Also returns how unlikely
    it is, the deviance but for a constant.
    """
    explained = np.full(len(variances), variances.mean())
    for _ in range(_ROUNDS):
        weight = term / explained**2
        factor = max(float((weight * (variances - known)).sum()), 0.0)
        factor /= max(float((weight * term).sum()), 1e-300)
        explained = np.maximum(known + factor * term, 1e-3 * variances)
    return factor, float((np.log(explained) + variances / explained).sum())


def _random(within: NDArray[np.float64], between: float) -> tuple[float, float, float]:
    """Total variance, white share and correlation length that explain V(4), V(8), V(16), M(4)."""
    shown = np.maximum(np.array([*within, between]), 1e-9)
    best = np.inf
    result = 1.0, 1.0, 0.0
    for width in _WIDTHS:
        hidden = correlated_residuals(width)
        predicted = np.array([*hidden[: len(within)], hidden[3]])
        terms = np.stack([np.ones(len(shown)), predicted], axis=1) / shown[:, None]
        (white, correlated), error = nnls(terms, np.ones(len(shown)))
        if error < best:
            best = error
            total = white + correlated
            result = float(total), float(white / total), width
    return result


def _quantisation(inverse: NDArray[np.float32]) -> tuple[float, float]:
    """Steps of the inverse range, 1/m, and of the range, metres, that an image is rounded to."""
    rows = inverse[:: max(len(inverse) // _ROWS, 1)]
    pairs = rows[:, 1:], rows[:, :-1]
    measured = (pairs[0] > 0) & (pairs[1] > 0)
    same = measured & (pairs[0] == pairs[1])
    measured &= ~same & (np.abs(pairs[0] - pairs[1]) < _COARSEST * pairs[0])
    unlike = np.count_nonzero(measured)
    # Without rounding neighbours are hardly ever the same.
    if unlike < _PER_BIN or np.count_nonzero(same) < _SAME * unlike:
        return 0.0, 0.0
    here, there = (side[measured].astype(np.float64) for side in pairs)
    step = np.abs(here - there)
    in_range = step / (here * there)
    (quantum, clear), (range_quantum, range_clear) = _common_step(step), _common_step(in_range)
    if max(clear, range_clear) < _CLEAR:
        return 0.0, 0.0
    return (quantum, 0.0) if clear > range_clear else (0.0, range_quantum)


def _common_step(steps: NDArray[np.float64]) -> tuple[float, float]:
    """The step of which the smaller ones of these are multiples, and how clearly they are."""
    small = _ranked(steps, _SMALLEST)
    # What was rounded twice is off by a little.
    near = np.abs(steps - small) < 0.2 * small
    beside = np.count_nonzero(steps < 1.8 * small) - np.count_nonzero(near)
    return float(np.median(steps[near])), float(np.count_nonzero(near)) / max(int(beside), 1)


def _quad_sums(values: NDArray[Any]) -> NDArray[Any]:
    """Sums (ceil(rows / 2), ceil(columns / 2)) of every 2 x 2 values."""
    rows, columns = values.shape
    even = np.zeros((rows + rows % 2, columns + columns % 2), values.dtype)
    even[:rows, :columns] = values
    return np.asarray(even.reshape(len(even) // 2, 2, -1, 2).sum(axis=(1, 3)))
