"""Errors of a sensor that explain what blocks of one size show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.alike import Sets, alike, quantiles
from rangeseg_ros.core.fitting.scale import Scale
from rangeseg_ros.core.sensing.sensor import FLOOR
from rangeseg_ros.core.significance import CERTAIN, chi2_quantile, f_quantile

# Rounds of least squares that settle the weights.
_ROUNDS = 5
# Half of the likelihood ratio that is no chance, for one block: chi-squared with one degree of
# freedom times the relative variance of a median of chi-squared with nine.
_CHANCE = chi2_quantile(1) / 2 * (np.pi / 2) * (2 / 9)
# F with one and 22 degrees of freedom, those of the 24 sets of an image of VGA: slopes that
# explain more are no chance. The few sets of small images would ask for more.
_SIGNIFICANT = f_quantile(1, 22)
# Directions that err one way alone, as those of scanners that turn: cameras show four standard
# deviations at most.
_CERTAIN = CERTAIN**2

BOTH = (1.0, 1.0)
"""Directions that err as much along the rows as down the columns."""


class Errors(NamedTuple):
    """A variance constant + quartic y^4 + tilt t at the inverse range y and squared slope t."""

    constant: float
    quartic: float
    tilt: float

    def times(self, factor: float) -> Errors:
        """So many times the variance."""
        return Errors(factor * self.constant, factor * self.quartic, factor * self.tilt)


class ByTurn(NamedTuple):
    """Sets of blocks (S,) that slope alike more down the columns than along the rows.

    The medians of the squared inverse ranges and slopes.
    """

    sets: Sets
    squared: NDArray[np.float64]
    across: NDArray[np.float64]
    down: NDArray[np.float64]


@register_jitable
def variances(
    errors: Errors, squared: NDArray[np.float64], slope: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Variances where the squares of inverse range and slope are these."""
    return FLOOR + errors.constant + errors.quartic * squared**2 + errors.tilt * slope


@register_jitable
def explaining(
    scale: Scale,
    variance: NDArray[np.float64],
    quantile: float,
    in_range: bool,
    least: Errors,
    known: Errors,
) -> Errors:
    """What explains the `variance` (N,) of most blocks of a scale.

    At `least` so much there is, and of this so much is `known` and not asked for. Errors are in
    disparity, or `in_range` if these explain more: of both together a few blocks tell nothing.
    """
    return Errors(*_explaining(scale, variance, quantile, in_range, least, known))


@njit(cache=True, nogil=True)
def _explaining(
    scale: Scale,
    variance: NDArray[np.float64],
    quantile: float,
    in_range: bool,
    least: Errors,
    known: Errors,
) -> tuple[float, float, float]:
    """Fields of the `Errors`."""
    squared = quantiles(scale.squared, scale.sets, 0.5)
    tilt = quantiles(scale.slope, scale.sets, 0.5)
    shown = quantiles(variance, scale.sets, quantile)
    shown = np.maximum(shown, variances(least, squared, tilt))
    there = variances(known, squared, tilt) - FLOOR
    blocks = len(scale.place) / len(shown)
    # What faces the sensor first: noise makes slopes of its own, that would explain it.
    # Indices and no slice: kernels are compiled for layouts, and a slice's follows the size.
    facing = np.arange(0, len(shown), scale.sets.slopes)
    ahead, before = shown[facing], there[facing]
    constant, unlikely = _likeliest(np.ones(len(facing)), ahead, before, blocks)
    quartic = 0.0
    if in_range:
        factor, less = _likeliest(squared[facing] ** 2, ahead, before, blocks)
        # One set is explained by either, and rounding would decide.
        if less < unlikely and len(facing) > 1:
            constant, quartic = 0.0, factor
    there += constant + quartic * squared**2
    straight, unlikely = _likeliest(tilt, shown, there, blocks)
    if there.min() > 0 and _advantage(_deviance(there, shown), unlikely, shown) < _SIGNIFICANT:
        straight = 0.0
    return constant, quartic, straight


def by_turn(
    squared: NDArray[np.float64], across: NDArray[np.float64], down: NDArray[np.float64]
) -> ByTurn:
    """What tells the way in which directions err.

    Of N blocks of these squared inverse ranges, and slopes along the row and down the column.
    """
    order, start, slopes, *medians = _by_turn(squared, across, down)
    return ByTurn(Sets(order, start, slopes), *medians)


@njit(cache=True, nogil=True)
def _by_turn(
    squared: NDArray[np.float64], across: NDArray[np.float64], down: NDArray[np.float64]
) -> tuple[
    NDArray[np.int32],
    NDArray[np.intp],
    int,
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]:
    """Fields of the `Sets` and of the `ByTurn`."""
    sets = alike(squared, down - across)
    order, start, slopes = sets
    medians = (
        quantiles(squared, sets, 0.5),
        quantiles(across, sets, 0.5),
        quantiles(down, sets, 0.5),
    )
    return order, start, slopes, *medians


@njit(cache=True, nogil=True)
def turning(
    turns: ByTurn, variance: NDArray[np.float64], quantile: float, noise: Errors, least: Errors
) -> tuple[float, tuple[float, float]]:
    """Tilt of the `noise`, and the way in which directions err: BOTH, or certainly one alone.

    Of blocks that have such a `variance` (N,), most of them by this quantile.
    """
    sets, squared, across, down = turns
    blocks = len(variance) / len(squared)
    shown = quantiles(variance, sets, quantile)
    shown = np.maximum(shown, variances(least, squared, across))
    there = variances(Errors(noise.constant, noise.quartic, 0.0), squared, across)
    _, cameras = _likeliest(across + down, shown, there, blocks)
    rows, along = _likeliest(across, shown, there, blocks)
    columns, below = _likeliest(down, shown, there, blocks)
    if _advantage(cameras, min(along, below), shown) < _CERTAIN:
        return noise.tilt, BOTH
    return (rows, (1.0, 0.0)) if along < below else (columns, (0.0, 1.0))


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
    unlikely = _deviance(explained, variances)
    if known.min() > 0:
        without = _deviance(known, variances)
        if without - unlikely < _CHANCE / blocks:
            return 0.0, without
    return factor, unlikely


@njit(cache=True)
def _deviance(explained: NDArray[np.float64], variances: NDArray[np.float64]) -> float:
    """How unlikely variances (N,) are where such (N,) are expected, but for a constant."""
    return (np.log(explained) + variances / explained).sum()


@njit(cache=True)
def _advantage(without: float, unlikely: float, variances: NDArray[np.float64]) -> float:
    """F of a term that makes variances (N,) so much less `unlikely` than they are `without`.

    Edges among the blocks of a set leave more than chance would: what is left of a perfect fit
    tells by how much (quasi-likelihood; Wedderburn 1974). 0 where too few tell.
    """
    freedom = max(len(variances) - 2, 0)
    left = unlikely - _deviance(variances, variances)
    return (without - unlikely) * freedom / max(left, 1e-12)
