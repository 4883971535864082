"""Minimum cuts against exhaustive search and against another implementation."""

from itertools import product

import numpy as np
import pytest

from rangeseg_ros.core.graphcut.cut import minimum_cut


def grid_graph(random, height, width, whole):
    """A grid with holes; weights are whole numbers, so that there are ties, or any."""
    inside = random.random((height, width)) < 0.85
    number = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
    count = int(inside.sum())
    neighbour, link = np.full((count, 4), -1, np.int32), np.zeros((count, 4))
    for i, j in np.argwhere(inside):
        for k, (a, b) in enumerate(((i, j + 1), (i + 1, j))):
            if a < height and b < width and inside[a, b]:
                p, q = number[i, j], number[a, b]
                weight = random.integers(0, 4) if whole else random.exponential(2)
                neighbour[p, k], neighbour[q, k + 2] = q, p
                link[p, k] = link[q, k + 2] = weight
    excess = random.integers(-5, 6, count) if whole else random.normal(0, 3, count)
    return excess.astype(float), neighbour, link


def value(chosen, excess, neighbour, link):
    total = excess[chosen].sum()
    for p, k in np.argwhere(neighbour >= 0):
        if k < 2 and chosen[p] != chosen[neighbour[p, k]]:
            total += link[p, k]
    return total


@pytest.mark.parametrize('whole', [True, False])
@pytest.mark.parametrize('seed', range(8))
def test_no_choice_is_better_and_of_equal_ones_the_smallest_is_taken(seed, whole):
    graph = grid_graph(np.random.default_rng(seed), 3, 4, whole)
    found = minimum_cut(*graph)
    choices = [np.array(choice) for choice in product([False, True], repeat=len(found))]
    values = np.array([value(choice, *graph) for choice in choices])
    assert value(found, *graph) == pytest.approx(values.min(), abs=1e-9)
    best = [choice for choice, at in zip(choices, values, strict=True) if at < values.min() + 1e-9]
    np.testing.assert_array_equal(found, np.logical_and.reduce(best))


@pytest.mark.parametrize('whole', [True, False])
@pytest.mark.parametrize('seed', range(10))
def test_larger_graphs_as_another_implementation(seed, whole):
    maxflow = pytest.importorskip('maxflow')
    random = np.random.default_rng(100 + seed)
    excess, neighbour, link = grid_graph(random, *random.integers(5, 60, 2), whole)
    graph = maxflow.GraphFloat(len(excess), link.size)
    nodes = graph.add_nodes(len(excess))
    graph.add_grid_tedges(nodes, np.maximum(excess, 0), np.maximum(-excess, 0))
    p, k = np.nonzero(neighbour[:, :2] >= 0)
    graph.add_edges(p, neighbour[p, k], link[p, k], link[p, k])
    graph.maxflow()
    np.testing.assert_array_equal(
        minimum_cut(excess, neighbour, link), graph.get_grid_segments(nodes)
    )


def test_graphs_without_edges_or_nodes():
    excess = np.array([-1.0, 0.0, 2.0])
    neighbour, link = np.full((3, 4), -1, np.int32), np.zeros((3, 4))
    np.testing.assert_array_equal(minimum_cut(excess, neighbour, link), [True, False, False])
    assert minimum_cut(excess[:0], neighbour[:0], link[:0]).shape == (0,)
