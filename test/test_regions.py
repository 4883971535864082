"""Connected components against SciPy's, noise regions by hand."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as graph_components

from rangeseg_ros.core.regions import (
    _perimeters,
    connected_components,
    drop_regions,
    plane_regions,
)
from rangeseg_ros.core.sensing.grid import Grid


def uncut(shape):
    return Grid(np.ones((shape[0], shape[1] - 1), bool), np.ones((shape[0] - 1, shape[1]), bool))


@pytest.mark.parametrize('seed', range(10))
def test_components_of_random_images(seed):
    random = np.random.default_rng(seed)
    h, w = random.integers(1, 25, 2)
    labels = random.integers(0, 3, (h, w))
    horizontal, vertical = random.random((h, w - 1)) < 0.8, random.random((h - 1, w)) < 0.8
    index = np.arange(h * w).reshape(h, w)
    right = horizontal & (labels[:, 1:] == labels[:, :-1])
    below = vertical & (labels[1:] == labels[:-1])
    i = np.concatenate([index[:, :-1][right], index[:-1][below]])
    j = np.concatenate([index[:, 1:][right], index[1:][below]])
    count, expected = graph_components(coo_array((np.ones(len(i)), (i, j)), (h * w, h * w)))
    found = connected_components(labels, Grid(horizontal, vertical), np.ones((h, w), bool))
    pairs = np.unique(np.stack([found.ravel(), expected]), axis=1)
    assert pairs.shape[1] == count == found.max() and found.min() == 1


@pytest.mark.parametrize(('shape', 'least'), [((480, 640), 7), ((960, 1280), 7), ((60, 80), 3)])
def test_thin_regions_are_noise(shape, least):
    """7 x 7: 49 pixels, 24 of them on the perimeter; 6 x 6: 36 and 20.

    A small image shows all regions smaller; what has an inner pixel is none of its noise.
    """
    labels = np.zeros(shape, np.int32)
    for k in range(1, 10):
        labels[10 : 10 + k, 7 * k : 7 * k + k] = k
    everywhere = np.ones(shape, np.bool_)
    found = plane_regions(labels, everywhere, uncut(shape), 'identify', 1)
    kept = {k for k in range(1, 10) if found[labels == k].all()}
    assert kept == set(range(least, 10))


def test_regions_left_keep_their_order():
    regions = np.array([[1, 1, 1, 1], [2, 2, 2, 3], [3, 4, 0, 0]], np.uint16)
    found = drop_regions(regions, np.array([True, False, True, False, False]))
    assert found.tolist() == [[1, 1, 1, 1], [0, 0, 0, 2], [2, 3, 0, 0]]
    assert found.dtype == np.uint16


@pytest.mark.parametrize(('noise_regions', 'line', 'speck'), [('leave', 2, 0), ('identify', 0, 0)])
def test_noise_regions_are_left_or_marked(noise_regions, line, speck):
    labels = np.zeros((40, 40), int)
    labels[:, 20] = 5
    labels[10, 10] = 5
    everywhere = np.ones((40, 40), bool)
    found = plane_regions(labels, everywhere, uncut((40, 40)), noise_regions, 30)
    assert found[20, 5] == 1
    assert found[20, 35] in (1, 2)
    assert (found[20, 20] > 0) == (line > 0)
    assert (found[10, 10] > 0) == (speck > 0)


def test_the_perimeter_is_what_lies_at_another_region_or_the_border_of_the_image():
    regions = np.zeros((9, 12), np.int32)
    regions[2:7, 3:9] = 1
    regions[4, 5] = 2
    upper, lower = (_perimeters(*rows, regions, 3) for rows in ((0, 4), (4, 9)))
    # Of region 1, its rim and the four around the hole.
    assert (upper + lower).tolist() == [2 * 12 + 2 * 7 + 2 * (5 + 6), 2 * 6 + 2 * 3 + 4, 1]


def test_small_regions_and_shadow_are_no_plane():
    labels = np.zeros((20, 20), int)
    labels[:5, :5] = 1
    valid = np.ones((20, 20), bool)
    valid[:, 15:] = False
    found = plane_regions(labels, valid, uncut((20, 20)), 'leave', 26)
    assert not found[:5, :5].any() and not found[:, 15:].any()
    assert (found[5:, :15] == 1).all()
