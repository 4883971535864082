"""What is no chance, and how many samples tell: the levels that all of the core shares."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rangeseg_ros.core.arrays import Floats

LEVEL = 0.999  # quantile that noise stays below: where it does not, something else is there
OUTLIER = 4.0  # standard deviations from which an error is no noise: one of 16 000 by chance
CLEARLY = 2.0  # how many times more must speak for one of two things than for the other
CAUCHY = 2.385  # deviations at which errors count half: 95 % efficient (Holland and Welsch 1977)
SAMPLES = 12  # that tell three parameters, those of a plane, or a quantile: four for each

# Log-odds of a look that finds what is in a cell and of one that does not, and their bounds
# (OctoMap; A. Hornung et al., Autonomous Robots 34 (3), 2013).
HIT, MISS, ODDS = 0.85, -0.4, (-2.0, 3.5)


def quantile(values: Floats, share: float) -> Floats:
    """Of values (..., N), the one (...,) that a share of them is below."""
    rank = int(share * (values.shape[-1] - 1))
    return np.partition(values, rank)[..., rank].copy()


def chi2_quantile(freedom: float, level: float = LEVEL) -> float:
    """Quantile of chi-squared with `freedom` degrees of freedom."""
    a = freedom / 2

    def probability(x: float) -> float:
        return math.exp(a * math.log(x) - x - math.lgamma(a + 1)) * _series(lambda n: x / (a + n))

    return 2 * _solve(probability, level, a + 10 * math.sqrt(a) + 20)


def f_quantile(freedom: float, others: float, level: float = LEVEL) -> float:
    """Quantile of F, the ratio of two mean squares with these degrees of freedom."""
    a, b = freedom / 2, others / 2
    scale = math.lgamma(a + b) - math.lgamma(a + 1) - math.lgamma(b)

    def probability(x: float) -> float:
        return math.exp(scale + a * math.log(x) + b * math.log1p(-x)) * _series(
            lambda n: x * (a + b + n - 1) / (a + n)
        )

    x = _solve(probability, level, 1 - 1e-9)
    return x * others / ((1 - x) * freedom)


def _series(ratio: Callable[[int], float]) -> float:
    """Sum of positive terms from 1 on, each `ratio` times the one before.

    The incomplete gamma and beta functions are made of these (Abramowitz and Stegun 6.5.29 and
    26.5.4): SciPy has both, and takes as long to import as all the rest of the core.
    """
    total = term = 1.0
    n = 1
    while term > 1e-17 * total:
        term *= ratio(n)
        total += term
        n += 1
    return total


def _solve(probability: Callable[[float], float], level: float, most: float) -> float:
    """Where a rising function between 0 and `most` reaches a level."""
    low, high = 0.0, most
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if probability(middle) < level else (low, middle)
    return middle
