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


def pairs_around(measured, i, j):
    """Pairs of measured pixels that a hole lies between, at most four apart: the closest first."""
    height, width = measured.shape
    found = []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ends = []
        for sign in (-1, 1):
            line = ((k, i + sign * k * di, j + sign * k * dj) for k in (1, 2, 3))
            inside = [(k, u, v) for k, u, v in line if 0 <= u < height and 0 <= v < width]
            ends.append(next((end for end in inside if measured[end[1:]] > 0), None))
        if all(ends) and ends[0][0] + ends[1][0] <= 4:
            found.append((ends[0][0] + ends[1][0], *ends))
    return sorted(found, key=lambda pair: pair[0])


@pytest.mark.parametrize('cloud', [False, True])
def test_a_hole_lies_between_two_of_its_row_column_or_diagonal(cloud):
    """The closest pair is interpolated where all continue each other."""
    draw, camera = np.random.default_rng(4), Camera(37, 30, 33.0, 34.0, 17.0, 15.0)
    inverse = draw.normal(0.5, 0.01, camera.shape).astype(np.float32)
    inverse *= draw.random(camera.shape) < 0.35
    steps = draw.uniform(0.005, 0.03, (8, 10)).astype(np.float32)
    slopes = draw.uniform(0, 0.005, (8, 10)).astype(np.float32)
    image = RangeImage(camera.rays, inverse, None if cloud else camera)
    whole = bridge_holes(image, steps, slopes)
    bridged, refused = 0, 0
    for i, j in np.argwhere(inverse == 0):
        pairs, here = pairs_around(inverse, i, j), (i // 4, j // 4)
        gaps = [abs(inverse[one[1:]] - inverse[other[1:]]) for _, one, other in pairs]
        allowed = [steps[here] + slopes[here] * span for span, *_ in pairs]
        if not pairs or any(gap > most for gap, most in zip(gaps, allowed, strict=True)):
            assert whole.inverse[i, j] == 0
            refused += bool(pairs)
            continue
        span, one, other = pairs[0]
        for values, found in ((inverse, whole.inverse), (image.rays, whole.rays)):
            expected = values[one[1:]] + one[0] / span * (values[other[1:]] - values[one[1:]])
            np.testing.assert_allclose(found[i, j], expected, rtol=1e-5, atol=1e-6)
        bridged += 1
    assert min(bridged, refused) > 50
    np.testing.assert_array_equal(whole.inverse[inverse > 0], inverse[inverse > 0])


def test_an_image_without_holes_is_itself():
    image = RangeImage(CAMERA.rays, crease()[0].astype(np.float32), CAMERA)
    some = np.ones((30, 40), np.float32)
    assert bridge_holes(image, some, some) is image
