"""Cuts, expansions and bands against exhaustive search, definitions and other programs."""

from itertools import product

import maxflow
import numpy as np
import pytest

from rangeseg_ros.core.graphcut.cut import minimum_cut
from rangeseg_ros.core.graphcut.expansion import (
    ROUNDING,
    GridLabelling,
    band,
    energy,
    expand,
    fronts,
    link_costs,
    minimise,
)
from rangeseg_ros.core.sensing.grid import Grid


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
def test_no_cut_is_better_and_of_equal_ones_the_smallest_is_taken(seed, whole):
    graph = grid_graph(np.random.default_rng(seed), 3, 4, whole)
    found = minimum_cut(*graph)
    choices = np.array(list(product([False, True], repeat=len(found))))
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


def test_graphs_without_edges_or_nodes():
    excess = np.array([-1.0, 0.0, 2.0])
    neighbour, link = np.full((3, 4), -1, np.int32), np.zeros((3, 4))
    np.testing.assert_array_equal(minimum_cut(excess, neighbour, link), [True, False, False])
    assert minimum_cut(excess[:0], neighbour[:0], link[:0]).shape == (0,)


class Problem:
    """A random labelling problem of h x w pixels and `count` labels."""

    def __init__(self, seed, h, w, count):
        random = np.random.default_rng(seed)
        self.unary = random.integers(0, 12, (count, h, w)).astype(np.float32)
        self.grid = Grid(
            *(
                random.choice([0.0, 0.5, 1.0, 2.0], shape, p=[0.2, *[0.8 / 3] * 3])
                for shape in ((h, w - 1), (h - 1, w))
            )
        )
        self.start = random.integers(0, count, (h, w))

    def energy(self, labels):
        """As the package works it out."""
        data = np.take_along_axis(self.unary, labels[None].astype(int), 0)[0]
        return energy(data, labels, link_costs(self.grid, 3.0))

    def labelling(self):
        labels = self.start.astype(np.int32)
        data = np.take_along_axis(self.unary, labels[None], 0).ravel()
        return GridLabelling.of(labels.ravel(), data, link_costs(self.grid, 3.0), labels.shape[1])

    def cost(self, label, pixels):
        return self.unary[label].ravel()[pixels]

    def expand(self, labelling, alpha):
        pixels = np.flatnonzero(labelling.labels != alpha).astype(np.int32)
        labelling.position[pixels] = np.arange(len(pixels))
        return expand(alpha, pixels, self.cost(alpha, pixels), labelling, ROUNDING)

    def image(self, labelling):
        return labelling.labels.reshape(self.start.shape)

    def energies(self, labels):
        """Energies (n,) of labellings (n, h, w), written without the code under test."""
        rows, columns = np.indices(labels.shape[1:])
        total = self.unary[labels, rows, columns].sum(axis=(1, 2), dtype=float)
        right, below = labels[:, :, 1:] != labels[:, :, :-1], labels[:, 1:] != labels[:, :-1]
        for unlike, weights in zip((right, below), self.grid, strict=True):
            total += 3.0 * (unlike * weights).sum(axis=(1, 2))
        return total


def choices(labels, free, values):
    """All labellings (n, h, w) whose free pixels (h, w) have one of the values."""
    picked = np.array(list(product(values, repeat=int(free.sum()))))
    every = np.repeat(labels[None], len(picked), axis=0)
    every[:, free] = picked
    return every


SEEDS = range(25)


@pytest.mark.parametrize('seed', SEEDS)
def test_each_expansion_is_the_best_of_its_space(seed):
    """From the definition: all pixels may take the label."""
    grid = Problem(seed, 3, 3, 4)
    labelling = grid.labelling()
    for alpha in (3, 1, 0, 2, 1):
        before = grid.image(labelling).copy()
        grid.expand(labelling, alpha)
        taken = choices(np.zeros((3, 3), int), np.ones((3, 3), bool), (0, 1))
        best = grid.energies(np.where(taken, alpha, before)).min()
        assert grid.energies(grid.image(labelling)[None])[0] == pytest.approx(best)


def test_no_accepted_expansion_raises_the_energy_and_none_is_left_that_lowers_it():
    grid = Problem(0, 20, 30, 6)
    labelling = grid.labelling()
    image = grid.image(labelling)
    first = last = grid.energy(image)
    accepted = 1
    while accepted:
        accepted = 0
        for alpha in range(6):
            before = image.copy()
            helped = grid.expand(labelling, alpha)
            now = grid.energy(image)
            assert now < last if helped else np.array_equal(before, image)
            accepted, last = accepted + helped, now
    minimise(labelling, 6, grid.cost)
    assert grid.energy(image) == last < first


@pytest.mark.parametrize('reach', [1, 2, 3, 5])
def test_a_band_has_the_sites_so_near_to_a_label(reach):
    rng = np.random.default_rng(reach)
    height, width, count = 14, 11, 4
    seen = 0
    for rows in [(0, height), (0, 6), (5, height)]:
        labels = rng.integers(0, count, (height, width)).astype(np.int32)
        labels[:, 4:] = labels[:, :1]
        links = rng.random((2, height, width)).astype(np.float32) * (
            rng.random((2, height, width)) > 0.2
        )
        links[0, :, -1] = links[1, -1] = 0
        pixels = labels.ravel(), links.reshape(2, -1)
        costs = np.zeros(labels.size, np.float32)
        start, sites = fronts(GridLabelling.of(pixels[0], costs, pixels[1], width), count, rows)
        inside = np.zeros(labels.shape, bool)
        inside[slice(*rows)] = True
        for alpha in range(count):
            labelling = GridLabelling.of(pixels[0], costs, pixels[1], width)
            front = sites[start[alpha] : start[alpha + 1]]
            assert inside.flat[front].all() and (pixels[0][front] != alpha).all()
            # Seeds may be sites that the label has already, and a site may come twice.
            own = np.flatnonzero((labels == alpha) & inside).astype(np.int32)
            front = np.concatenate([own[:3], front, front, own[3:]])
            found = band(alpha, front, reach, labelling, rows)
            # The label's own count from beyond the rows, too; what is reached lies in them.
            reached = labels == alpha
            for _ in range(reach):
                more = reached.copy()
                more[:, 1:] |= reached[:, :-1] & (links[0, :, :-1] > 0)
                more[:, :-1] |= reached[:, 1:] & (links[0, :, :-1] > 0)
                more[1:] |= reached[:-1] & (links[1, :-1] > 0)
                more[:-1] |= reached[1:] & (links[1, :-1] > 0)
                reached |= more & inside
            assert set(found.tolist()) == set(np.flatnonzero(reached & (labels != alpha)).tolist())
            assert (labelling.position[found] == np.arange(len(found))).all()
            assert np.count_nonzero(labelling.position >= 0) == len(found)
            seen += len(found)
    assert seen > 100
