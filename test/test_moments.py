"""Moments against numpy's least squares."""

import numpy as np
import pytest

from rangeseg_ros.core.sensing.moments import CHI2, COUNT, SIZE, fit, fit_all


def pixels(seed, count=200):
    """Rays (n, 3) float32, inverse ranges and weights (n,) of random pixels near a plane."""
    random = np.random.default_rng(seed)
    rays = np.column_stack([random.uniform(-0.6, 0.6, (count, 2)), np.ones(count)])
    rays = rays.astype(np.float32)
    inverse = rays @ random.uniform(0.1, 0.6, 3) + random.normal(0, 0.01, count)
    return rays, inverse, random.uniform(0.5, 4, count)


def moments_of(rays, inverse, weight):
    rays = rays.astype(float)
    square = np.einsum('n,ni,nj->ij', weight, rays, rays)[np.triu_indices(3)]
    sums = [*square, *(weight * inverse) @ rays, weight @ inverse**2, len(rays)]
    return np.pad(sums, (0, SIZE - len(sums)))


def fitted(moments):
    theta = np.full(3, np.nan)
    return theta, fit(moments, theta)


@pytest.mark.parametrize('seed', range(5))
def test_fit_is_weighted_least_squares(seed):
    rays, inverse, weight = pixels(seed)
    root = np.sqrt(weight)
    expected, residual, _, _ = np.linalg.lstsq(root[:, None] * rays, root * inverse, rcond=None)
    theta, chi2 = fitted(moments_of(rays, inverse, weight))
    np.testing.assert_allclose(theta, expected, rtol=1e-6)
    assert chi2 == pytest.approx(residual[0], rel=1e-6)


def test_moments_add_up():
    rays, inverse, weight = pixels(7)
    parts = [
        moments_of(rays[part], inverse[part], weight[part])
        for part in (slice(0, 30), slice(30, 31), slice(31, None))
    ]
    whole = moments_of(rays, inverse, weight)
    np.testing.assert_allclose(np.sum(parts, axis=0), whole, rtol=1e-12)
    assert whole[COUNT] == 200
    assert whole[CHI2] == pytest.approx((weight * inverse**2).sum())


@pytest.mark.parametrize('case', ['nothing', 'one pixel', 'two pixels', 'a row', 'a line'])
def test_pixels_that_determine_no_plane(case):
    rays, inverse, weight = pixels(8, 40)
    if case == 'nothing':
        rays, inverse, weight = rays[:0], inverse[:0], weight[:0]
    elif case == 'one pixel':
        rays[:] = rays[0]
    elif case == 'two pixels':
        rays[:] = rays[np.arange(40) % 2]
    elif case == 'a row':
        rays[:, 1] = 0.25
    else:
        rays[:, 1] = 0.5 * rays[:, 0] - 0.125
    moments = moments_of(rays, inverse, weight)
    theta, chi2 = fitted(moments)
    assert not theta.any()
    assert chi2 == moments[CHI2]
    many, residuals = fit_all(np.stack([moments, moments_of(*pixels(9))]))
    assert not many[0].any() and many[1].any()
    assert residuals[0] == chi2
