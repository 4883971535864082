"""The pyramid of grids: parts that hang together, and the energy of the pixels at every level."""

import numpy as np
import pytest
from scipy.ndimage import label

from rangeseg_ros.core.by_normals.pyramid import Pyramid
from rangeseg_ros.core.graphcut.energy import energy
from rangeseg_ros.core.sensing.grid import Grid

LEVELS = 4


def random_grid(seed, height=45, width=61):
    """Edges of random weight, many of them 0."""
    random = np.random.default_rng(seed)
    right = random.choice([0.0, 0.5, 1.0], (height, width - 1), p=[0.3, 0.2, 0.5])
    below = random.choice([0.0, 0.5, 1.0], (height - 1, width), p=[0.3, 0.2, 0.5])
    return Grid(right.astype(np.float32), below.astype(np.float32))


def parts(grid, inside):
    """Numbers of the connected parts of some pixels, drawn with the edges between them."""
    height, width = inside.shape
    drawn = np.zeros((2 * height - 1, 2 * width - 1), bool)
    drawn[::2, ::2] = inside
    drawn[::2, 1::2] = (grid.right > 0) & inside[:, 1:] & inside[:, :-1]
    drawn[1::2, ::2] = (grid.below > 0) & inside[1:] & inside[:-1]
    return label(drawn)[0][::2, ::2]


@pytest.mark.parametrize('shape', [(45, 61), (1, 1), (1, 9), (16, 32)])
@pytest.mark.parametrize('seed', range(3))
def test_sites_are_connected_and_the_largest_of_their_cell(seed, shape):
    grid = random_grid(seed, *shape)
    pyramid = Pyramid.of(grid, 3.0, LEVELS)
    for level in range(1, LEVELS + 1):
        size = 1 << level
        for i in range(0, shape[0], size):
            for j in range(0, shape[1], size):
                cell = np.zeros(shape, bool)
                cell[i : i + size, j : j + size] = True
                found = cell & (pyramid.top >= level)
                assert parts(grid, found).max() == 1
                if level == 1:
                    sizes = np.bincount(parts(grid, cell).ravel())[1:]
                    assert found.sum() == sizes.max()


@pytest.mark.parametrize('seed', range(5))
def test_energy_of_a_level_is_that_of_the_pixels(seed):
    """Of the pixels that are part of it: the edges of the others are cut."""
    grid, smoothness = random_grid(seed), 3.0
    random = np.random.default_rng(seed + 100)
    pyramid = Pyramid.of(grid, smoothness, LEVELS)
    for level in range(1, LEVELS + 1):
        inside = pyramid.top >= level
        cut = Grid(
            grid.right * (inside[:, 1:] & inside[:, :-1]),
            grid.below * (inside[1:] & inside[:-1]),
        )
        links = pyramid.links[level]
        labels = random.integers(0, 3, links.shape[1:])
        rows, columns = np.indices(inside.shape) >> level
        pixels = labels[rows, columns]
        coarse = links[0, :, :-1][labels[:, 1:] != labels[:, :-1]].sum()
        coarse += links[1, :-1][labels[1:] != labels[:-1]].sum()
        assert coarse == pytest.approx(energy(np.zeros(inside.shape), pixels, cut, smoothness))
        assert (links[0, :, -1] == 0).all() and (links[1, -1] == 0).all()
