"""What is no chance, and how many samples tell: the levels that all of the core shares."""

from __future__ import annotations

from scipy.special import fdtri, gammaincinv

LEVEL = 0.999
"""Quantile that noise stays below: where it does not, something else is there."""
OUTLIER = 4.0
"""Standard deviations from which an error is none of the noise: one of 16 000 by chance."""
CERTAIN = 6.0
"""The same for what is asked once of an image or a recording, and changes all of it if so."""
CLEARLY = 2.0
"""How many times more must speak for one of two things than for the other."""
SAMPLES = 12
"""Samples that tell three parameters, those of a plane, or a quantile: four for each."""


def chi2_quantile(freedom: float, level: float = LEVEL) -> float:
    """Quantile of chi-squared with so many degrees of freedom."""
    return 2 * float(gammaincinv(freedom / 2, level))


def f_quantile(freedom: float, others: float, level: float = LEVEL) -> float:
    """Quantile of the ratio of two mean squares with so many degrees of freedom (F)."""
    return float(fdtri(freedom, others, level))
