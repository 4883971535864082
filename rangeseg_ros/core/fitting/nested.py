"""Blocks against the four that each consists of, scale by scale: noise alike and distortion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.alike import median
from rangeseg_ros.core.fitting.errors import Errors, explaining, variances
from rangeseg_ros.core.fitting.scale import (
    ENOUGH,
    QUANTILE,
    Scale,
    choose,
    mean_of_sets,
    pixels_of,
    variance_ratio,
)
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks, merged_alone, slope_of
from rangeseg_ros.core.significance import SAMPLES, chi2_quantile

# Chi-squared of 9 degrees of freedom, of what one plane through four blocks leaves, over its mean:
# what is rougher is no part of a plane, and the median.
_BENT = chi2_quantile(9) / 9
_MEDIAN = chi2_quantile(9, 0.5) / 9


class Compared(NamedTuple):
    """The blocks of a scale that consist of four flat ones.

    Attributes
    ----------
    whole : (rows, columns) bool
        Which do.
    level : (rows, columns) float64
        Variances expected of them: the mean of those of the four.
    excess : (rows, columns) float64
        What one plane leaves beyond the planes of the four, for each degree of freedom and over
        the median of what that is by chance.
    enough : bool
        Whether there are so many that they tell anything.
    scale : Scale
        Of them.
    """

    whole: NDArray[np.bool_]
    level: NDArray[np.float64]
    excess: NDArray[np.float64]
    enough: bool
    scale: Scale


class Nested(NamedTuple):
    """What all scales show, from blocks of 8 pixels up; nothing where these are too few.

    Attributes
    ----------
    within, freedom : (S,) float64
        What a `QUANTILE` of the blocks of each shows of the variance expected, see `Ratio`.
    between : float
        The same of the median that four blocks of 4 pixels differ by.
    filled : float
        Measured share of most blocks.
    distortion : Errors
        The largest that any scale shows.
    """

    within: NDArray[np.float64]
    freedom: NDArray[np.float64]
    between: float
    filled: float
    distortion: Errors


@njit(cache=True, nogil=True)
def compare(
    flat: NDArray[np.bool_],
    residual: NDArray[np.float64],
    level: NDArray[np.float64],
    blocks: Blocks,
    way: tuple[float, float],
) -> Compared:
    """Blocks (rows, columns) against the four of each, as far as these are `flat`.

    `residual` and `level` are those of the four, `way` is that in which directions err.
    """
    shape = blocks.squared.shape
    count, mean, excess = np.zeros(shape, np.uint8), np.zeros(shape), np.zeros(shape)
    for i in range(flat.shape[0]):
        for j in range(flat.shape[1]):
            count[i // 2, j // 2] += flat[i, j]
            mean[i // 2, j // 2] += level[i, j] / 4
            excess[i // 2, j // 2] += residual[i, j]
    whole, found = np.zeros(shape, np.bool_), 0
    for i in range(shape[0]):
        for j in range(shape[1]):
            whole[i, j] = count[i, j] == 4
            found += whole[i, j]
            excess[i, j] = max(blocks.residual[i, j] - excess[i, j], 0.0) / (9 * _MEDIAN)
    return Compared(whole, mean, excess, found >= SAMPLES, choose(blocks, whole, way, ENOUGH))


def over_scales(
    flat: NDArray[np.bool_],
    residual: NDArray[np.float64],
    level: NDArray[np.float64],
    blocks: Blocks,
    rays: NDArray[np.float32],
    way: tuple[float, float],
    in_range: bool,
    shown: Errors,
) -> Nested:
    """What blocks of 8 pixels show, and larger ones as long as there are enough of them.

    More than seven parameters: those of a kernel, which takes arrays.

    Parameters
    ----------
    flat : (rows, columns) bool
        Blocks of 4 pixels that count.
    residual, level : (rows, columns) float64
        Theirs, and the variances expected of them.
    blocks : Blocks
        Those of 8 pixels.
    rays : (H, W, 3) float32
        Of the image.
    way : tuple of 2 float
        In which directions err.
    in_range : bool
        Whether the sensor errs in range: lasers do so alone.
    shown : Errors
        Those new in every pixel, as the smallest blocks show them.
    """
    found = _over_scales(flat, residual, level, blocks, rays, way, in_range, shown)
    return Nested(*found[:4], Errors(*found[4]))


@njit(cache=True, nogil=True)
def _over_scales(
    flat: NDArray[np.bool_],
    residual: NDArray[np.float64],
    level: NDArray[np.float64],
    blocks: Blocks,
    rays: NDArray[np.float32],
    way: tuple[float, float],
    in_range: bool,
    shown: Errors,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float, tuple[float, float, float]]:
    """Fields of the `Nested`."""
    compared = compare(flat, residual, level, blocks, way)
    none = Errors(0.0, 0.0, 0.0)
    distortion, side = none, 2 * BLOCK
    within, freedom = [0.0], [0.0]
    within.clear()
    freedom.clear()
    between = filled = 1.0
    most = 0.0
    while compared.enough:
        scale = compared.scale
        relative, excess = np.empty(len(scale.place)), np.empty(len(scale.place))
        columns = blocks.squared.shape[1]
        for k, place in enumerate(scale.place):
            i, j = place // columns, place % columns
            excess[k] = compared.excess[i, j]
            relative[k] = excess[k] / compared.level[i, j]
        bending = explaining(scale, excess, 0.5, in_range, none, shown)
        ratio = variance_ratio(scale, blocks, compared.level)
        within.append(mean_of_sets(scale, ratio.values, QUANTILE))
        freedom.append(ratio.freedom)
        # Of each of the four: s^2 where there are no holes.
        pixels = median(pixels_of(scale, blocks)) / 4
        if side == 2 * BLOCK:
            between = mean_of_sets(scale, relative, 0.5)
            filled = pixels / BLOCK**2
        # M(s) = v + D^2 n / 8, with n pixels in a block. What grows with the slope are creases.
        smooth = Errors(8 / pixels * bending.constant, 8 / pixels * bending.quartic, 0.0)
        typical = _typical(smooth, scale)
        if typical > most:
            most, distortion = typical, smooth
        flat = _not_bent(compared, blocks, way, shown, bending)
        side *= 2
        larger = merged_alone(blocks, rays, side)
        compared = compare(flat, blocks.residual, compared.level, larger, way)
        blocks = larger
    errors = distortion.constant, distortion.quartic, distortion.tilt
    return np.array(within), np.array(freedom), between, filled, errors


@njit(cache=True, nogil=True)
def _typical(errors: Errors, scale: Scale) -> float:
    """Median of the variance of errors."""
    return median(variances(errors, scale.squared, scale.slope))


@njit(cache=True, nogil=True)
def _not_bent(
    compared: Compared,
    blocks: Blocks,
    way: tuple[float, float],
    shown: Errors,
    bending: Errors,
) -> NDArray[np.bool_]:
    """Blocks (rows, columns) that bend no more than noise and distortion explain."""
    flat = compared.whole.copy()
    for i in range(flat.shape[0]):
        for j in range(flat.shape[1]):
            slope = slope_of(blocks, i, j, way)
            expected = variances(shown, blocks.squared[i, j], slope)
            expected += variances(bending, blocks.squared[i, j], slope)
            flat[i, j] &= compared.excess[i, j] < _BENT * expected
    return flat
