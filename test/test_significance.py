"""Quantiles against those of SciPy."""

import pytest
from scipy.stats import chi2, f

from rangeseg_ros.core.significance import LEVEL, chi2_quantile, f_quantile


@pytest.mark.parametrize('level', [0.05, 0.5, 0.99, LEVEL])
def test_quantiles(level):
    for freedom in (0.5, 1, 2, 3, 6, 9, 13, 15.7, 60):
        expected = chi2.ppf(level, freedom)
        assert chi2_quantile(freedom, level) == pytest.approx(expected, rel=1e-10)
    for freedom, others in ((0.5, 100), (3, 2), (6, 22), (13, 9.5)):
        expected = f.ppf(level, freedom, others)
        assert f_quantile(freedom, others, level) == pytest.approx(expected, rel=1e-8)
