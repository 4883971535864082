"""Counts of the thesis's tables A.1 and A.3, and what every distribution must satisfy."""

import numpy as np
import pytest

from rangeseg_ros import ConfigError
from rangeseg_ros.core.by_normals.directions import directions, platonic, regular


@pytest.mark.parametrize(('subdivisions', 'count'), list(enumerate([4, 17, 73, 305, 1249])))
def test_platonic_counts_of_table_a3(subdivisions, count):
    assert len(platonic(subdivisions)) == count
    assert len(directions('platonic', count)) == count


@pytest.mark.parametrize(('n', 'count'), [(1, 1), (2, 9), (3, 25), (4, 49), (8, 225), (18, 1225)])
def test_regular_counts_of_table_a1(n, count):
    assert len(regular(n)) == count
    assert len(directions('regular', count)) == count


@pytest.mark.parametrize(
    ('distribution', 'count'),
    [('platonic', 305), ('regular', 225), ('spiral', 1), ('spiral', 300), ('random', 298)],
)
def test_unit_vectors_towards_the_sensor_all_different(distribution, count):
    found = directions(distribution, count)
    assert found.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    assert (found[:, 2] < 0).all()
    assert len(np.unique(found.round(9), axis=0)) == count


@pytest.mark.parametrize(('distribution', 'count'), [('platonic', 305), ('spiral', 305)])
def test_even_distributions_leave_no_large_gap(distribution, count):
    """Each direction's share of the hemisphere is a cap of 4.6 degrees; no gap is twice that."""
    random = np.random.default_rng(0).normal(size=(4000, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    random = random[random[:, 2] < -0.2]
    nearest = np.degrees(np.arccos((random @ directions(distribution, count).T).max(axis=1)))
    assert nearest.max() < 9


def test_rejection_is_uniform_over_the_hemisphere():
    """Height is uniform on a hemisphere (Archimedes): mean 1/2, variance 1/12."""
    height = -directions('random', 5000, seed=3)[:, 2]
    assert height.mean() == pytest.approx(1 / 2, abs=0.015)
    assert height.var() == pytest.approx(1 / 12, abs=0.005)


def test_rejection_repeats_with_its_seed():
    first, again, other = (directions('random', 50, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    ('distribution', 'count', 'message'),
    [
        ('platonic', 300, '17, 73, 305'),
        ('regular', 24, 'odd square'),
        ('regular', 16, 'odd square'),
        ('spiral', 0, 'positive'),
        ('sunflower', 10, 'sunflower'),
    ],
)
def test_impossible_counts_are_refused(distribution, count, message):
    with pytest.raises(ConfigError, match=message):
        directions(distribution, count)
