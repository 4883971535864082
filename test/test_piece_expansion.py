"""Expansion of labels over the pieces of an image, against exhaustive search."""

import numpy as np
import pytest

from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.by_normals.octahedral import UNIT
from rangeseg_ros.core.by_normals.piece_expansion import expand
from rangeseg_ros.core.by_normals.pieces import pieces
from rangeseg_ros.core.by_normals.region_moves import turn
from rangeseg_ros.core.graphcut.expansion import grouped

DIRECTIONS = directions('platonic', 73)


def noisy(truth, seed):
    random = np.random.default_rng(seed)
    normals = truth + 0.25 * random.normal(size=truth.shape)
    return (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)


def value(parts, labels):
    """Energy of labellings (..., n) of pieces."""
    graph = parts.graph
    one = np.repeat(np.arange(labels.shape[-1]), np.diff(graph.start))
    unlike = labels[..., one] != labels[..., graph.neighbours]
    data = UNIT * parts.costs[np.arange(labels.shape[-1]), labels].astype(float)
    return data.sum(axis=-1) + (unlike * graph.links.astype(float)).sum(axis=-1) / 2


@pytest.mark.parametrize('seed', range(20))
def test_no_expansion_improves_what_expansions_left(seed):
    """Of any label in use, by any set of pieces; all are within reach."""
    random = np.random.default_rng(seed)
    chosen = DIRECTIONS[random.permutation(len(DIRECTIONS))[:4]]
    normals = noisy(chosen[random.integers(0, 4, (4, 4))].repeat(2, 0).repeat(2, 1), seed)
    horizontal, vertical = random.uniform(0.1, 1, (8, 7)), random.uniform(0.1, 1, (7, 8))
    parts = pieces(normals, chosen, horizontal, vertical, 20.0)
    labels, count = parts.votes.copy(), len(parts.votes)
    assert 4 <= count <= 16
    last = np.inf
    while value(parts, labels) < last:
        last = value(parts, labels)
        expand(labels, parts.costs, parts.graph)
    sets = ((np.arange(2**count)[:, None] >> np.arange(count)) & 1).astype(bool)
    for alpha in np.unique(labels):
        assert value(parts, np.where(sets, alpha, labels)).min() >= last - 0.01


def test_a_label_comes_up_far_from_where_it_is():
    """Thirty pieces from the pieces of label 5, an island that it suits and 40 does not."""
    truth = np.empty((16, 400, 3))
    truth[:] = DIRECTIONS[40]
    truth[:, :30] = truth[4:12, 340:370] = DIRECTIONS[5]
    parts = pieces(noisy(truth, 0), DIRECTIONS, np.ones((16, 399)), np.ones((15, 400)), 10.0)
    labels = np.full(len(parts.votes), 40, np.int32)
    labels[np.unique(parts.image[:, :20])] = 5
    expand(labels, parts.costs, parts.graph)
    found = labels[parts.image]
    assert np.mean(found[:, :30] == 5) > 0.95
    assert np.mean(found[5:11, 341:369] == 5) > 0.95
    assert (found[:, 50:330] == 40).all()


def test_what_the_prior_forbids_does_not_come_up():
    """A stray saves less than its border costs."""
    truth = np.empty((24, 24, 3))
    truth[:] = DIRECTIONS[40]
    truth[:, :8] = truth[12:14, 16:18] = DIRECTIONS[5]
    normals = truth.astype(np.float32)
    parts = pieces(normals, DIRECTIONS, np.ones((24, 23)), np.ones((23, 24)), 100.0)
    labels = parts.votes.copy()
    assert len(set(labels[np.unique(parts.image[8:16, 16:24])])) == 2
    expand(labels, parts.costs, parts.graph)
    assert (labels[parts.image][:, :8] == 5).all() and (labels[parts.image][:, 8:] == 40).all()


@pytest.mark.parametrize('seed', range(5))
def test_turned_regions_that_meet_turn_as_one(seed):
    """Noisy tiles of one surface end as one region, whatever label they had."""
    truth = np.empty((24, 64, 3))
    truth[:] = DIRECTIONS[seed + 20]
    arguments = noisy(truth, seed), DIRECTIONS, np.ones((24, 63)), np.ones((23, 64))
    parts = pieces(*arguments, 100.0)
    labels = np.random.default_rng(seed).integers(0, 73, len(parts.votes)).astype(np.int32)
    turn(labels, parts.costs, parts.graph)
    assert (labels == parts.costs.sum(axis=0, dtype=int).argmin()).all()


@pytest.mark.parametrize('seed', range(3))
def test_sites_grouped_by_label_keep_their_order(seed):
    random = np.random.default_rng(seed)
    labels = random.integers(0, 7, 50).astype(np.int32)
    sites = random.permutation(50).astype(np.int32)
    start, result = grouped(labels, sites, 9)
    assert start.tolist() == [np.count_nonzero(labels < k) for k in range(10)]
    assert result.tolist() == sites[np.argsort(labels, kind='stable')].tolist()


def test_a_corner_of_another_surface_is_cut_out_of_its_tile():
    truth = np.empty((8, 16, 3), np.float32)
    truth[:] = DIRECTIONS[40]
    truth[:2, :2] = DIRECTIONS[5]
    parts = pieces(truth, DIRECTIONS, np.ones((8, 15)), np.ones((7, 16)), 10.0)
    sizes = np.bincount(parts.image.ravel())
    assert sorted(sizes) == [4, 4, 4, 4, 16, 16, 16, 64]
    assert (parts.votes[parts.image] == np.where((truth == truth[0, 0]).all(axis=2), 5, 40)).all()
