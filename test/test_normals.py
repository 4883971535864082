"""Observed normals of exact planes, and the directions that are labels (thesis, A.1 and A.3)."""

from itertools import product

import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.by_normals.labelling import _largest_parts, minimise
from rangeseg_ros.core.by_normals.normals import cross_product, observed_normals, plane_fit
from rangeseg_ros.core.sensing.grid import Grid

CAMERA = Camera(40, 30, 50.0, 55.0, 19.0, 15.5)
BOTH = [*product((cross_product, plane_fit), (1, 3))]
METHODS = pytest.mark.parametrize(('method', 'reach'), BOTH)


def plane_image(normal, distance, camera=CAMERA):
    """Exact depth of the plane normal . p + distance = 0, zero where it is behind the sensor."""
    with np.errstate(divide='ignore'):
        depth = -distance / (camera.rays.astype(float) @ np.asarray(normal, float))
    depth[~(depth > 0)] = 0
    return RangeImage.from_depth(depth, camera)


@METHODS
@pytest.mark.parametrize(
    'normal', [(0, 0, -1), (0.3, -0.4, -np.sqrt(0.75)), (-0.6, 0.0, -0.8), (0, -0.8, -0.6)]
)
def test_normal_of_an_exact_plane(normal, method, reach):
    image = plane_image(normal, 1.7)
    found = method(image, reach)
    defined = np.isfinite(found[..., 0])
    assert defined.any() and (defined[8:-8, 8:-8].all() or not image.valid.all())
    assert np.arccos(np.clip(found[defined] @ normal, -1, 1)).max() < np.radians(0.1)
    np.testing.assert_allclose(np.linalg.norm(found[defined], axis=1), 1, atol=1e-5)


@METHODS
def test_clouds_of_another_frame_point_to_the_sensor_too(method, reach):
    """The wall x = 2 in front of a scanner that looks along x."""
    azimuth = np.radians(np.linspace(-20, 20, 40))[None, :]
    elevation = np.radians(np.linspace(15, -15, 30))[:, None]
    y, z = 2 * np.tan(azimuth), 2 * np.tan(elevation) / np.cos(azimuth)
    points = np.stack(np.broadcast_arrays(2.0, y, z), axis=-1)
    found = method(RangeImage.from_points(points), reach)
    np.testing.assert_allclose(found[15, 20], [-1, 0, 0], atol=2e-3)


@METHODS
def test_undefined_at_the_border_and_beside_shadow_and_nowhere_else(method, reach):
    depth = plane_image((0, 0, -1), 1.0).points[..., 2].copy()
    depth[15, 20] = np.nan
    found = np.isfinite(method(RangeImage.from_depth(depth, CAMERA), reach)[..., 0])
    rows, columns = np.indices(found.shape)
    inside = (rows >= reach) & (rows < 30 - reach) & (columns >= reach) & (columns < 40 - reach)
    assert not found[~inside].any() and not found[[15, 15, 15 - reach], [20, 20 + reach, 20]].any()
    assert found[inside & (np.hypot(rows - 15, columns - 20) > 1.5 * reach)].all()


def test_thesis_form_is_the_cross_product_of_the_four_neighbours():
    image = RangeImage.from_depth(np.random.default_rng(0).uniform(1, 2, CAMERA.shape), CAMERA)
    p = image.points.astype(float)
    y, x = 11, 17
    expected = np.cross(p[y, x + 1] - p[y, x - 1], p[y + 1, x] - p[y - 1, x])
    expected *= -np.sign(expected @ p[y, x]) / np.linalg.norm(expected)
    np.testing.assert_allclose(cross_product(image, 1)[y, x], expected, atol=1e-4)


def test_tangents_do_not_cross_disconnected_edges():
    image = plane_image((0, 0, -1), 1.0)
    horizontal, vertical = np.ones((30, 39), bool), np.ones((29, 40), bool)
    horizontal[12, 20] = 0  # between the pixels 20 and 21 of row 12
    config = Config(method='normals', normal_baseline=3)
    found = np.isfinite(observed_normals(image, Grid(horizontal, vertical), config)[..., 0])
    assert list(np.flatnonzero(~found[12, 3:-3]) + 3) == [18, 19, 20, 21, 22, 23]
    assert found[11, 3:-3].all() and found[13, 3:-3].all()


@pytest.mark.parametrize('count', [4, 17, 73, 305, 1249])
def test_unit_vectors_towards_the_sensor_all_different_without_a_large_gap(count):
    """As many as table A.3 has; each one's share of the hemisphere is a cap."""
    found = directions(count)
    assert found.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    assert (found[:, 2] < 0).all() and len(np.unique(found.round(9), axis=0)) == count
    random = np.random.default_rng(0).normal(size=(4000, 3))
    random *= -np.sign(random[:, 2:]) / np.linalg.norm(random, axis=1, keepdims=True)
    assert np.arccos((random @ found.T).max(axis=1)).max() < 2 * np.arccos(1 - 1 / count)


def test_labels_of_a_single_row_grow_over_its_only_edge():
    known, labels = directions(73).astype(np.float32), np.repeat([5, 9], 20)[None]
    grid = Grid(np.ones((1, 39), bool), np.ones((0, 40), bool))
    np.testing.assert_array_equal(minimise(known[labels], known, grid, 40.0), labels)


def test_of_parts_as_large_a_square_has_one():
    grid = Grid(np.tile(np.arange(7) != 3, (8, 1)), np.ones((7, 8), bool))
    assert np.count_nonzero(_largest_parts(grid)) == 32
