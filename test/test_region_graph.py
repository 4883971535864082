"""Contacts of parts of a grid, while parts join."""

import numpy as np
import pytest

from rangeseg_ros.core.by_planes.region_graph import absorb, find_contacts, least_contact


def borders(part, right, below, count):
    """Length of the border between every two parts, by definition."""
    found = np.zeros((count, count))
    for one, other, touch in (
        (part[:, :-1], part[:, 1:], right),
        (part[:-1], part[1:], below),
    ):
        for a, b in zip(one[touch], other[touch], strict=True):
            if a != b and a > 0 and b > 0:
                found[a, b] += 1
                found[b, a] += 1
    return found


def as_matrix(contacts, values):
    """Values (2E,) of the half-edges from part to part, as chains lead to them; nan for none."""
    count = len(contacts.head)
    told = np.full((count, count), np.nan)
    for a in range(count):
        h = contacts.head[a]
        while h >= 0:
            if contacts.length[h // 2] > 0:
                assert np.isnan(told[a, contacts.target[h]])
                told[a, contacts.target[h]] = values[h]
            h = contacts.link[h]
    return told


@pytest.mark.parametrize('seed', range(4))
def test_contacts_stay_those_of_the_grid(seed):
    rng = np.random.default_rng(seed)
    shape, count = (14, 17), 25
    coarse = rng.integers(0, count, (7, 9), np.int32)
    part = coarse.repeat(2, 0).repeat(2, 1)[:, : shape[1]]
    right = rng.random((shape[0], shape[1] - 1)) < 0.8
    below = rng.random((shape[0] - 1, shape[1])) < 0.8
    contacts = find_contacts(part, right, below, count)
    strips = rng.random((len(contacts.target), 2))
    told = [as_matrix(contacts, strips[:, k]) for k in range(2)]
    for _ in range(15):
        found = borders(part, right, below, count)
        length = as_matrix(contacts, contacts.length.repeat(2))
        assert np.array_equal(np.nan_to_num(length), found)
        for k in range(2):
            assert np.allclose(as_matrix(contacts, strips[:, k]), told[k], equal_nan=True)
            assert np.array_equal(np.isnan(told[k]), found == 0)
        a, b = (int(k) for k in rng.choice(np.argwhere(found > 0)))
        part[part == b] = a
        absorb(contacts, strips, a, b)
        for matrix in told:
            for way in (matrix, matrix.T):
                both = np.nansum(way[[a, b]], 0)
                both[[a, b]] = 0
                way[a] = np.where(both > 0, both, np.nan)
            matrix[b] = matrix[:, b] = np.nan


@pytest.mark.parametrize('seed', range(4))
def test_the_least_contact_is_that_of_a_later_part(seed):
    rng = np.random.default_rng(seed)
    part = rng.integers(0, 9, (6, 7), np.int32)
    right, below = np.ones((6, 6), np.bool_), np.ones((5, 7), np.bool_)
    contacts = find_contacts(part, right, below, 9)
    values = rng.random(len(contacts.length))
    told = as_matrix(contacts, values.repeat(2))
    for a in range(9):
        later = np.where(np.isnan(told[a, a + 1 :]), np.inf, told[a, a + 1 :])
        h, least = least_contact(contacts, values, a, np.inf)
        assert least == pytest.approx(later.min(initial=np.inf))
        assert h == -1 or contacts.target[h] == a + 1 + later.argmin()
