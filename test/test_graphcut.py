"""Cuts, expansions and bands against exhaustive search, definitions and other programs."""

from itertools import product

import maxflow
import numpy as np
import pytest

from rangeseg_ros.core.graphcut import expansion
from rangeseg_ros.core.graphcut.cut import minimum_cut
from rangeseg_ros.core.graphcut.expansion import GridLabelling
from rangeseg_ros.core.sensing.grid import Grid


def grid_graph(random, height, width, whole):
    """A grid with holes; weights are whole numbers, so that there are ties, or any."""
    inside = random.random((height, width)) < 0.85
    number = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
    count = int(inside.sum())
    neighbour, link = np.full((count, 4), -1, np.int32), np.zeros((count, 4))
    for k, pair in enumerate(((number[:, :-1], number[:, 1:]), (number[:-1], number[1:]))):
        p, q = np.stack(pair)[:, np.minimum(*pair) >= 0]
        weight = random.integers(0, 4, len(p)) if whole else random.exponential(2, len(p))
        neighbour[p, k], neighbour[q, k + 2] = q, p
        link[p, k] = link[q, k + 2] = weight
    excess = random.integers(-5, 6, count) if whole else random.normal(0, 3, count)
    return excess.astype(float), neighbour, link


def value(chosen, excess, neighbour, link):
    parted = (neighbour >= 0) & (chosen[neighbour] != chosen[:, None])
    return excess[chosen].sum() + link[:, :2][parted[:, :2]].sum()


@pytest.mark.parametrize('whole', [True, False])
@pytest.mark.parametrize('shape', [(3, 4), (1, 1), (0, 0)])
@pytest.mark.parametrize('seed', range(8))
def test_no_cut_is_better_and_of_equal_ones_the_smallest_is_taken(seed, shape, whole):
    graph = grid_graph(np.random.default_rng(seed), *shape, whole)
    found = minimum_cut(*graph)
    choices = np.array(list(product([False, True], repeat=len(found))), bool)
    values = np.array([value(choice, *graph) for choice in choices])
    assert value(found, *graph) == pytest.approx(values.min(), abs=1e-9)
    np.testing.assert_array_equal(found, choices[values < values.min() + 1e-9].all(axis=0))


def test_larger_graphs_are_cut_as_by_another_implementation():
    random = np.random.default_rng(100)
    for whole in 10 * (True, False):
        excess, neighbour, link = grid_graph(random, *random.integers(5, 60, 2), whole)
        graph = maxflow.GraphFloat(len(excess), link.size)
        nodes = graph.add_nodes(len(excess))
        graph.add_grid_tedges(nodes, np.maximum(excess, 0), np.maximum(-excess, 0))
        p, k = np.nonzero(neighbour[:, :2] >= 0)
        graph.add_edges(p, neighbour[p, k], link[p, k], link[p, k])
        graph.maxflow()
        found = minimum_cut(excess, neighbour, link)
        np.testing.assert_array_equal(found, graph.get_grid_segments(nodes))


def energies(many, unary, grid):
    """Energies (n,) of labellings (n, H, W), from the definition."""
    rows, columns = np.indices(many.shape[1:])
    total = unary[many, rows, columns].sum(axis=(1, 2), dtype=float)
    total += 3.0 * ((np.diff(many, axis=2) != 0) * grid.right).sum(axis=(1, 2))
    return total + 3.0 * ((np.diff(many, axis=1) != 0) * grid.below).sum(axis=(1, 2))


@pytest.mark.parametrize('seed', range(25))
def test_each_expansion_is_the_best_of_its_space_and_in_the_end_none_helps(seed):
    """From the definition: any pixels may take the label."""
    random = np.random.default_rng(seed)
    unary = random.integers(0, 12, (4, 3, 3)).astype(np.float32)
    grid = Grid(*(random.choice([0.0, 0.5, 1.0, 2.0], shape) for shape in ((3, 2), (2, 3))))
    labels = random.integers(0, 4, (3, 3), np.int32)
    data, links = np.take_along_axis(unary, labels[None], 0)[0], expansion.link_costs(grid, 3.0)
    labelling = GridLabelling.of(labels.ravel(), data.ravel(), links, 3)
    taken = np.array(list(product([False, True], repeat=9))).reshape(-1, 3, 3)

    def least(alpha):
        return pytest.approx(energies(np.where(taken, alpha, labels), unary, grid).min())

    for alpha in (3, 1):
        sites, best = np.flatnonzero(labels != alpha).astype(np.int32), least(alpha)
        labelling.position[sites] = np.arange(len(sites))
        expansion.expand(alpha, sites, unary[alpha].flat[sites], labelling, expansion.ROUNDING)
        assert (
            energies(labels[None], unary, grid)[0] == expansion.energy(data, labels, links) == best
        )
    expansion.minimise(labelling, 4, lambda label, pixels: unary[label].flat[pixels])
    assert all(expansion.energy(data, labels, links) == least(alpha) for alpha in range(4))


@pytest.mark.parametrize('rows', [(0, 14), (0, 6), (5, 14)])
@pytest.mark.parametrize('reach', [1, 2, 3, 5])
def test_a_band_has_the_sites_so_near_to_a_label(reach, rows):
    rng = np.random.default_rng(reach)
    labels = rng.integers(0, 4, (14, 11), np.int32)
    labels[:, 4:] = labels[:, :1]
    links = rng.random((2, 14, 11), np.float32) * (rng.random((2, 14, 11)) > 0.2)
    links[0, :, -1] = links[1, -1] = 0
    costs = np.zeros(labels.size, np.float32)
    labelling = GridLabelling.of(labels.ravel(), costs, links.reshape(2, -1), 11)
    start, sites = expansion.fronts(labelling, 4, rows)
    inside = np.zeros(labels.shape, bool)
    inside[slice(*rows)] = True
    right, down = links[0, :, :-1] > 0, links[1, :-1] > 0
    for alpha in range(4):
        front = sites[start[alpha] : start[alpha + 1]]
        assert inside.flat[front].all() and (labels.flat[front] != alpha).all()
        # Seeds may be sites that the label has already, and a site may come twice.
        own = np.flatnonzero((labels == alpha) & inside).astype(np.int32)
        front = np.concatenate([own[:3], front, front, own[3:]])
        labelling.position[:] = -1
        found = expansion.band(alpha, front, reach, labelling, rows)
        # The label's own count from beyond the rows, too; what is reached lies in them.
        reached = labels == alpha
        for _ in range(reach):
            more = reached.copy()
            more[:, 1:] |= reached[:, :-1] & right
            more[:, :-1] |= reached[:, 1:] & right
            more[1:] |= reached[:-1] & down
            more[:-1] |= reached[1:] & down
            reached |= more & inside
        assert sorted(found) == np.flatnonzero(reached & (labels != alpha)).tolist() != []
        assert (labelling.position[found] == np.arange(len(found))).all()
        assert np.count_nonzero(labelling.position >= 0) == len(found)
        won = labelling._replace(labels=np.where(labelling.position < 0, labels.ravel(), alpha))
        after = expansion.beyond(alpha, found, won, rows)
        assert inside.flat[after].all() and (won.labels[after] != alpha).all()
