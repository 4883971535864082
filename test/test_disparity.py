"""Disparities that are taken for depth are found, and segmented as what they are."""

import numpy as np
import pytest

from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.disparity import from_disparity, shows_disparity
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera


@pytest.fixture(scope='module')
def seen():
    return simulate_kinect(kinect_room(731), seed=731, sensor_seed=731)


def disparities(frame, levels=None):
    """As floats, or rounded to so many levels, in whatever unit."""
    depth = frame.depth.astype(np.float64)
    values = np.where(depth > 0, 3000 / np.maximum(depth, 1), 0)
    if levels:
        values = np.round(values * levels / values.max()) * 10 / levels
    return RangeImage.from_depth(values.astype(np.float32), frame.camera)


@pytest.mark.parametrize('levels', [None, 255])
def test_disparities_are_found_and_segmented_as_such(seen, levels):
    image = disparities(seen, levels)
    assert shows_disparity(image)
    result = Segmenter().segment(image)
    assert result.image is image and result.verdict.invalid
    assert result.verdict.reasons[0] == 'disparity instead of depth'
    assert result.ground is None and not result.terrain.any()
    depth = Segmenter().segment(RangeImage.from_depth(seen.depth, seen.camera))
    assert depth.verdict.ok
    for plane in depth.planes[:3]:
        own = depth.labels == plane.label
        same = result.labels == np.bincount(result.labels[own]).argmax()
        assert (own & same).sum() > 0.9 * (own | same).sum()


def test_disparities_of_disparities_are_depths(seen):
    """But for a factor."""
    image = RangeImage.from_depth(seen.depth, seen.camera)
    again = from_disparity(disparities(seen)).inverse
    np.testing.assert_array_equal(again > 0, image.valid)
    ratio = again[image.valid] / image.inverse[image.valid]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)


def test_nothing_is_told_from_little():
    camera = simulate_kinect(kinect_room(731), seed=731).camera
    for depth in (np.zeros(camera.shape, np.uint16), np.full(camera.shape, 2000, np.uint16)):
        assert not shows_disparity(RangeImage.from_depth(depth, camera))


@pytest.mark.parametrize('size', [(160, 120), (320, 240), (640, 480)])
def test_a_crease_is_no_bend(size):
    """Along a floor that meets a wall every block beside the other shows the same."""
    camera = kinect_camera(*size)
    depth = np.minimum(0.8 / np.maximum(camera.rays[..., 1], 1e-6), 3)
    assert not shows_disparity(RangeImage.from_depth(depth, camera))
    # A small image tells too little.
    assert shows_disparity(RangeImage.from_depth(1 / depth, camera)) == (size[0] > 160)


@pytest.mark.parametrize('focal', [1e4, 1e7, 1e12])
def test_narrow_views_tell_nothing_and_pass(focal):
    camera = Camera(640, 480, focal, focal, 319.5, 239.5)
    depth = np.random.default_rng(1).uniform(1, 2, camera.shape)
    assert not shows_disparity(RangeImage.from_depth(depth, camera))
