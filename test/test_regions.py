"""Connected components against SciPy's, small ones by hand."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as graph_components

from rangeseg_ros.core import regions
from rangeseg_ros.core.sensing.grid import Grid


@pytest.mark.parametrize('seed', range(10))
def test_components_of_random_images(seed):
    random = np.random.default_rng(seed)
    h, w = random.integers(1, 25, 2)
    labels = random.integers(0, 3, (h, w))
    horizontal, vertical = random.random((h, w - 1)) < 0.8, random.random((h - 1, w)) < 0.8
    index = np.arange(h * w).reshape(h, w)
    valid = random.random((h, w)) < 0.9
    right = horizontal & (labels[:, 1:] == labels[:, :-1]) & valid[:, 1:] & valid[:, :-1]
    below = vertical & (labels[1:] == labels[:-1]) & valid[1:] & valid[:-1]
    i = np.concatenate([index[:, :-1][right], index[:-1][below]])
    j = np.concatenate([index[:, 1:][right], index[1:][below]])
    count, expected = graph_components(coo_array((np.ones(len(i)), (i, j)), (h * w, h * w)))
    found = regions.connected_components(labels, Grid(horizontal, vertical), valid)
    pairs = np.unique(np.stack([found[valid], expected[valid.ravel()]]), axis=1)
    assert pairs.shape[1] == count - np.count_nonzero(~valid) == found.max()
    np.testing.assert_array_equal(found > 0, valid)


def test_the_smallest_plane_follows_the_image():
    sizes = (0, (480, 640)), (0, (240, 320)), (0, (1, 1)), (7, (480, 640))
    assert [regions.least_pixels(*size) for size in sizes] == [300, 75, 1, 7]


def test_regions_left_keep_their_order():
    labels = np.array([[1, 1, 1, 1], [2, 2, 2, 3], [3, 4, 0, 0]], np.uint16)
    numbers = regions.numbers_of(np.array([False, True, False, True, True]))
    found = regions.relabel(labels, numbers)
    assert found.tolist() == [[1, 1, 1, 1], [0, 0, 0, 2], [2, 3, 0, 0]]
    assert found.dtype == np.uint16


def test_small_regions_and_shadow_are_no_plane():
    labels = np.zeros((20, 20), int)
    labels[:5, :5] = 1
    valid = np.ones((20, 20), bool)
    valid[:, 15:] = False
    uncut = Grid(np.ones((20, 19), bool), np.ones((19, 20), bool))
    found = regions.plane_regions(labels, valid, uncut, 26)
    assert not found[:5, :5].any() and not found[:, 15:].any() and (found[5:, :15] == 1).all()
