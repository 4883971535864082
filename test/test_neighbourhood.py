"""Weights of the 4-connected grid."""

import numpy as np
import pytest

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.grid import weights
from rangeseg_ros.core.sensing.range_image import RangeImage


def image_of(depth):
    height, width = np.shape(depth)
    return RangeImage.from_depth(np.array(depth, float), Camera(width, height, 10.0, 10.0, 0, 0))


def test_every_edge_between_measurements_weighs_one():
    horizontal, vertical = weights(image_of([[1, 1, 0], [1, 1, 1]]))
    assert horizontal.dtype == vertical.dtype == np.float32
    assert horizontal.tolist() == [[1, 0], [1, 1]]
    assert vertical.tolist() == [[1, 1, 0]]


def test_jumps_are_disconnected():
    jumps = np.array([[True, False], [False, False]]), np.array([[False, False, True]])
    horizontal, vertical = weights(image_of(np.ones((2, 3))), jumps)
    assert horizontal.tolist() == [[0, 1], [1, 1]]
    assert vertical.tolist() == [[1, 1, 0]]


def test_distance_weights_fall_with_the_distance_about_the_median():
    image = image_of([[1.0, 1.0, 1.0, 1.5], [1.0, 1.0, 1.0, 1.5]])
    horizontal, vertical = weights(image, weighting='distance')
    points = image.points
    across = np.linalg.norm(np.diff(points, axis=1), axis=2)
    down = np.linalg.norm(np.diff(points, axis=0), axis=2)
    median = np.median(np.concatenate([across.ravel(), down.ravel()]))
    np.testing.assert_allclose(horizontal, 2 * median / (median + across), rtol=1e-5)
    np.testing.assert_allclose(vertical, 2 * median / (median + down), rtol=1e-5)
    assert horizontal[0, 2] < 0.5 < horizontal[0, 0]


@pytest.mark.parametrize('weighting', ['uniform', 'distance'])
@pytest.mark.parametrize('shape', [(1, 1), (1, 4), (3, 2)])
def test_shadow_is_disconnected_and_small_images_pass(shape, weighting):
    horizontal, vertical = weights(image_of(np.zeros(shape)), None, weighting)
    assert horizontal.shape == (shape[0], shape[1] - 1) and not horizontal.any()
    assert vertical.shape == (shape[0] - 1, shape[1]) and not vertical.any()
