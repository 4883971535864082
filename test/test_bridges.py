"""Holes that part no surface, and shadows that do."""

import numpy as np
import pytest
from clouds import cloud_of

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.bridges import bridge_holes
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage

CAMERA = Camera(160, 120, 146.0, 146.0, 79.5, 59.5)
ROWS, COLUMNS = np.indices(CAMERA.shape)
HOLES = {
    'random': np.random.default_rng(0).random(CAMERA.shape) < 0.3,
    'every second row': ROWS % 2 == 1,
    'every fourth column': COLUMNS % 4 == 3,
    'chequered': (ROWS + COLUMNS) % 2 == 1,
    'registered 1.1 times larger': (ROWS % 11 == 10) | (COLUMNS % 11 == 10),
    'registered 1.33 times larger': (ROWS % 4 == 3) | (COLUMNS % 4 == 3),
}


def crease(noise=0.001):
    """Inverse depth of two walls that meet in the middle, and the wall of each pixel."""
    random = np.random.default_rng(1)
    left, right = CAMERA.rays @ np.array([0.2, 0.0, 0.6]), CAMERA.rays @ np.array([-0.2, 0.0, 0.6])
    inverse = np.maximum(left, right) + random.normal(0, noise, CAMERA.shape)
    return inverse, np.where(left > right, 1, 2)


def steps_and_slopes(step, slope):
    blocks = -(-CAMERA.height // 4), -(-CAMERA.width // 4)
    return np.full(blocks, step, np.float32), np.full(blocks, slope, np.float32)


@pytest.mark.parametrize('cloud', [False, True])
@pytest.mark.parametrize('holes', HOLES.values(), ids=HOLES)
def test_holes_part_no_plane_and_stay_holes(holes, cloud):
    inverse, truth = crease()
    depth = np.where(holes, np.nan, 1 / inverse).astype(np.float32)
    image = RangeImage.from_depth(depth, CAMERA)
    if cloud:
        image = cloud_of(depth[..., None] * CAMERA.rays)
    result = Segmenter(Config()).segment(image)
    assert len(result.planes) == 2
    assert not result.labels[holes].any()
    for wall in (1, 2):
        found = result.labels[(truth == wall) & ~holes]
        assert np.bincount(found).max() > 0.95 * len(found)


@pytest.mark.parametrize('gap', [1, 2, 3])
def test_a_shadow_beside_a_jump_stays(gap):
    inverse = np.where(COLUMNS < 80, 1.0, 0.5)
    inverse[:, 80 : 80 + gap] = 0
    image = RangeImage(CAMERA.rays, inverse.astype(np.float32), CAMERA)
    whole = bridge_holes(image, *steps_and_slopes(0.01, 0.001))
    np.testing.assert_array_equal(whole.inverse, image.inverse)


def test_what_is_bridged_lies_between_its_neighbours():
    inverse, _ = crease(0.0)
    holes = HOLES['every fourth column']
    image = RangeImage(CAMERA.rays, np.where(holes, 0, inverse).astype(np.float32), CAMERA)
    whole = bridge_holes(image, *steps_and_slopes(0.01, 0.01))
    inner = holes & (COLUMNS < 159) & (np.abs(COLUMNS - 79.5) > 2)
    np.testing.assert_allclose(whole.inverse[inner], inverse[inner], atol=1e-5)
    np.testing.assert_array_equal(whole.inverse[~holes], image.inverse[~holes])


@pytest.mark.parametrize('step', [(0, 1), (1, 0), (1, 1), (1, -1)])
def test_a_hole_lies_between_two_of_its_row_column_or_diagonal(step):
    inverse = np.zeros(CAMERA.shape, np.float32)
    for side in (-1, 1):
        inverse[60 + side * step[0], 80 + side * step[1]] = 0.5
    whole = bridge_holes(RangeImage(CAMERA.rays, inverse, CAMERA), *steps_and_slopes(0.01, 0.01))
    expected = inverse.copy()
    expected[60, 80] = 0.5
    np.testing.assert_array_equal(whole.inverse, expected)


def test_wide_holes_stay_and_an_image_without_any_is_itself():
    inverse, _ = crease(0.0)
    image = RangeImage(CAMERA.rays, inverse.astype(np.float32), CAMERA)
    assert bridge_holes(image, *steps_and_slopes(0.01, 0.01)) is image
    inverse[40:60, 20:40] = 0
    image = RangeImage(CAMERA.rays, inverse.astype(np.float32), CAMERA)
    whole = bridge_holes(image, *steps_and_slopes(0.01, 0.01))
    assert not whole.inverse[42:58, 22:38].any()
