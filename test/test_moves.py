"""Expansion and swap against exhaustive search on grids small enough for it."""

from itertools import product

import numpy as np
import pytest

from rangeseg_ros.core.graphcut.energy import energy
from rangeseg_ros.core.graphcut.moves import Labelling
from rangeseg_ros.core.sensing.grid import Grid


class Problem:
    """A random labelling problem of h x w pixels and `count` labels."""

    def __init__(self, seed, h, w, count, cut=0.2, smoothness=3.0):
        random = np.random.default_rng(seed)
        self.unary = random.integers(0, 12, (count, h, w)).astype(np.float32)
        self.horizontal = random.choice(
            [0.0, 0.5, 1.0, 2.0], (h, w - 1), p=[cut, *[(1 - cut) / 3] * 3]
        )
        self.vertical = random.choice(
            [0.0, 0.5, 1.0, 2.0], (h - 1, w), p=[cut, *[(1 - cut) / 3] * 3]
        )
        self.smoothness = smoothness
        self.start = random.integers(0, count, (h, w))

    def energy(self, labels):
        data = np.take_along_axis(self.unary, labels[None].astype(int), 0)[0]
        return energy(data, labels, Grid(self.horizontal, self.vertical), self.smoothness)

    def labelling(self, start=None):
        return Labelling(
            self.start if start is None else start,
            lambda label, pixels: self.unary[label].ravel()[pixels],
            Grid(self.horizontal, self.vertical),
            self.smoothness,
        )

    def all_energies(self):
        """Energies (count ** pixels,) of all labellings, written without the code under test."""
        count, h, w = self.unary.shape
        labels = np.array(list(product(range(count), repeat=h * w))).reshape(-1, h, w)
        rows, columns = np.indices((h, w))
        total = self.unary[labels, rows, columns].sum(axis=(1, 2), dtype=float)
        for y, x in np.ndindex(h, w):
            if x + 1 < w:
                unlike = labels[:, y, x] != labels[:, y, x + 1]
                total += self.smoothness * self.horizontal[y, x] * unlike
            if y + 1 < h:
                unlike = labels[:, y, x] != labels[:, y + 1, x]
                total += self.smoothness * self.vertical[y, x] * unlike
        return total

    def expansions(self, labels, alpha):
        """All labellings within one expansion of alpha."""
        for chosen in product([False, True], repeat=labels.size):
            yield np.where(np.reshape(chosen, labels.shape), alpha, labels)


SEEDS = range(25)


@pytest.mark.parametrize('moves', ['expansion', 'swap'])
@pytest.mark.parametrize('seed', SEEDS)
def test_two_labels_give_the_optimum(seed, moves):
    grid = Problem(seed, 3, 4, 2)
    labelling = grid.labelling()
    labelling.minimise(2, moves)
    assert grid.energy(labelling.image) == pytest.approx(grid.all_energies().min())


@pytest.mark.parametrize('seed', SEEDS)
def test_each_expansion_is_the_best_of_its_move_space(seed):
    grid = Problem(seed, 3, 3, 4)
    labelling = grid.labelling()
    for alpha in (0, 3, 1, 2):
        best = min(grid.energy(near) for near in grid.expansions(labelling.image.copy(), alpha))
        labelling.expand(alpha)
        assert grid.energy(labelling.image) == pytest.approx(best)


@pytest.mark.parametrize('seed', SEEDS)
def test_each_swap_is_the_best_of_its_move_space(seed):
    grid = Problem(seed, 3, 3, 3)
    labelling = grid.labelling()
    for alpha, beta in ((0, 1), (2, 0), (1, 2)):
        before = labelling.image.copy()
        free = (before == alpha) | (before == beta)
        choices = product([alpha, beta], repeat=int(free.sum()))
        best = np.inf
        for choice in choices:
            proposal = before.copy()
            proposal[free] = choice
            best = min(best, grid.energy(proposal))
        labelling.swap(alpha, beta)
        assert grid.energy(labelling.image) == pytest.approx(best)


@pytest.mark.parametrize('moves', ['expansion', 'swap'])
def test_no_accepted_move_raises_the_energy_and_none_is_left_that_lowers_it(moves):
    grid = Problem(0, 20, 30, 6)
    labelling = grid.labelling()
    last = grid.energy(labelling.image)
    tries = range(6) if moves == 'expansion' else [(a, b) for a in range(6) for b in range(a)]

    def attempt(label):
        return labelling.expand(label) if moves == 'expansion' else labelling.swap(*label)

    while True:
        accepted = 0
        for label in tries:
            before = labelling.image.copy()
            helped = attempt(label)
            now = grid.energy(labelling.image)
            assert now < last if helped else np.array_equal(before, labelling.image)
            accepted += helped
            last = now
        if not accepted:
            break
    labelling.minimise(6, moves)
    assert grid.energy(labelling.image) == last


def test_minimise_stops_after_the_rounds_it_is_given():
    few, many = Problem(4, 12, 12, 5).labelling(), Problem(4, 12, 12, 5).labelling()
    few.minimise(5, cycles=1)
    for alpha in range(5):
        many.expand(alpha)
    np.testing.assert_array_equal(few.image, many.image)
    assert any(few.expand(alpha) for alpha in range(5))
