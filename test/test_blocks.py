"""Sums over pixels, the planes that fit them, and links: against definitions and NumPy."""

import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.by_planes.patches import Nodes
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.grid import Grid, View, grid_of
from rangeseg_ros.core.sensing.moments import CHI2, COUNT, RATIO, SIZE, fit_all
from rangeseg_ros.core.sensing.sensor import SensorModel


def grid(height, width, seed=0):
    """Inverse range and rays of a noisy plane, and neighbourhood weights without jumps."""
    random = np.random.default_rng(seed)
    rays = np.ones((height, width, 3), np.float32)
    rays[..., 0] = (np.arange(width) - width / 2) / 50
    rays[..., 1] = ((np.arange(height) - height / 2) / 50)[:, None]
    inverse = rays @ np.array([0.1, -0.05, 0.5]) + random.normal(0, 0.002, (height, width))
    edges = Grid(np.ones((height, width - 1), bool), np.ones((height - 1, width), bool))
    return inverse.astype(np.float32), rays, edges


def nodes_of(inverse, rays, edges, **sensor):
    """Blocks of 2 x 2 pixels that surfaces are grown from."""
    image, model = RangeImage(rays, inverse), SensorModel.from_config(Config(**sensor))
    return Nodes.of(View(image, image, edges, model, 1, 0.0, True))


@pytest.mark.parametrize('hole', [(2, 2), (3, 2), (2, 3), np.s_[4], np.s_[:4, 4]])
def test_slopes_do_not_need_the_rays_of_holes(hole):
    """Those in the middle of a block, which clouds do not have."""
    _, rays, _ = grid(14, 10)
    # Beyond the image, whose blocks at the border are no whole ones, is something else.
    rays[10:], rays = 9, rays[:10]
    inverse = (rays @ np.array([0.1, -0.05, 0.5])).astype(np.float32)
    for holes in (hole, np.s_[4:8, 5:8:2]):
        rays[holes], inverse[holes] = 0, 0
    blocks = Blocks.of(RangeImage(rays, inverse))
    np.testing.assert_allclose(blocks.slope, (0.1 / 50) ** 2 + (0.05 / 50) ** 2, rtol=1e-3)


@pytest.mark.parametrize('shape', [(1, 1), (5, 131), (9, 300)])
@pytest.mark.parametrize('size', [2, 3, 4])
def test_blocks_are_sums_over_their_pixels(shape, size):
    """Of images wider than what is summed at a time, with holes where no ray is."""
    inverse, rays, _ = grid(*shape)
    holes = np.random.default_rng(1).random(shape) < 0.3
    inverse[holes], rays[holes] = 0, np.nan
    blocks = Blocks.of(RangeImage(rays, inverse), size)
    for i, j in np.ndindex(blocks.squared.shape):
        part = np.s_[size * i : size * (i + 1), size * j : size * (j + 1)]
        own, y = (array[part][~holes[part]].astype(float) for array in (rays, inverse))
        expected = [*(own.T @ own)[np.triu_indices(3)], *own.T @ y, y @ y, len(y), 0, 0]
        np.testing.assert_allclose(blocks.moments[i, j], expected, rtol=1e-12, atol=1e-15)
        assert blocks.squared[i, j] == pytest.approx(y @ y / max(len(y), 1), rel=1e-12)
    whole, sums = blocks.merged(rays, 2 * size), blocks.moments
    for axis in (0, 1):
        sums = np.add.reduceat(sums, np.arange(0, sums.shape[axis], 2), axis)
    np.testing.assert_allclose(whole.moments, sums, rtol=1e-12)


@pytest.mark.parametrize('size', [2, 4])
def test_blocks_of_an_image_that_changes_are_those_of_the_new_one(size):
    before, rays, _ = grid(41, 62)
    after = before * np.where(np.random.default_rng(size).random(before.shape) < 0.02, 1.1, 1)
    after[5:9, 7:20] = 0
    before, after = RangeImage(rays, before), RangeImage(rays, after.astype(np.float32))
    found = Blocks.of(before, size).updated(before, after, size)
    for own, new in zip(found, Blocks.of(after, size), strict=True):
        np.testing.assert_array_equal(own, new)


def test_blocks_that_jumps_cross_or_that_lack_two_measurements_are_left_out():
    """Only those: an edge on the border of two blocks, or beside a hole, crosses neither."""
    inverse, rays, edges = grid(6, 10)
    horizontal, vertical = edges
    horizontal[1, 0] = 0  # inside block (0, 0)
    vertical[4, 5] = 0  # inside block (2, 2)
    horizontal[2, 3] = 0  # between blocks (1, 1) and (1, 2)
    vertical[1, 6] = 0  # between blocks (0, 3) and (1, 3)
    inverse[0, 9] = 0
    horizontal[0, 8] = vertical[0, 9] = 0
    inverse[2:4, 0] = inverse[4:, 8:] = 0
    expected = np.ones((3, 5), bool)
    expected[[0, 2, 1, 2], [0, 2, 0, 4]] = False
    kept = nodes_of(inverse, rays, edges).moments[..., COUNT] > 0
    np.testing.assert_array_equal(kept, expected)


@pytest.mark.parametrize('shape', [(12, 16), (11, 13), (9, 18), (1, 1), (1, 9), (9, 1), (3, 5)])
def test_blocks_touch_where_an_edge_joins_them(shape):
    height, width = shape
    random = np.random.default_rng(sum(shape))
    horizontal = random.random((height, width - 1)) < 0.5
    vertical = random.random((height - 1, width)) < 0.5
    inverse, rays, _ = grid(height, width)
    nodes = nodes_of(inverse, rays, Grid(horizontal, vertical))
    right = np.logical_or.reduceat(horizontal[:, 1::2], np.arange(0, height, 2), axis=0)
    below = np.logical_or.reduceat(vertical[1::2], np.arange(0, width, 2), axis=1)
    np.testing.assert_array_equal(nodes.right, right)
    np.testing.assert_array_equal(nodes.below, below)
    assert not (nodes.moments[..., COUNT] > 0)[:, width // 2 :].any(), 'half a block'


def test_slopes_and_residuals_are_those_of_the_planes():
    inverse, rays, _ = grid(40, 60)
    inverse[np.random.default_rng(6).random(inverse.shape) < 0.5] = 0
    blocks = Blocks.of(RangeImage(rays, inverse))
    for i, j in np.ndindex(10, 15):
        part = np.s_[4 * i : 4 * i + 4, 4 * j : 4 * j + 4]
        own, y = (array[part][inverse[part] > 0].astype(float) for array in (rays, inverse))
        theta, (square,), _, _ = np.linalg.lstsq(own, y, rcond=None)
        assert blocks.residual[i, j] == pytest.approx(square, rel=1e-6)
        # Rays are 1/50 apart; noise of variance v turns planes of n pixels by 2 * 12 v / 15 n.
        expected = (np.hypot(*theta[:2]) / 50) ** 2 - 1.6 * square / (len(y) - 3) / len(y)
        assert blocks.slope[i, j] == pytest.approx(max(expected, 0), rel=1e-4)


@pytest.mark.parametrize('theta', [(0.0, 0.0, 0.3), (0.1, -0.8, 0.9), (-0.6, 0.1, 1.5)])
def test_an_exact_plane_leaves_no_more_than_float32_rounds(theta):
    """Pixels of a large image are so near in direction that its planes are hardly determined."""
    camera = Camera(1280, 720, 700.0, 700.0, 639.5, 359.5)
    inverse = np.maximum(camera.rays.astype(float) @ theta, 0).astype(np.float32)
    blocks = Blocks.of(RangeImage(camera.rays, inverse, camera))
    whole = blocks.moments[..., COUNT] == 16
    assert np.quantile(np.sqrt(blocks.residual[whole] / 13), 0.99) < 2e-5


def test_weights_count_in_variances_of_the_sensor():
    inverse, rays, edges = grid(80, 80, seed=4)
    nodes = nodes_of(inverse, rays, edges, noise=0.002, distortion=0.004, pixel_noise=0.0)
    plain = Blocks.of(RangeImage(rays, inverse), 2)
    theta, residual = fit_all(nodes.moments.reshape(-1, SIZE))
    unweighted, _ = fit_all(plain.moments.reshape(-1, SIZE))
    np.testing.assert_allclose(theta, unweighted, rtol=1e-6, atol=1e-7)
    # Chi-squared of 4 - 3 degrees of freedom each; 1600 blocks: 3.5 % of standard error.
    assert residual.mean() == pytest.approx(1, rel=0.12)
    np.testing.assert_allclose(nodes.residual.ravel(), residual, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(nodes.moments[..., RATIO], 4 * 4.0, rtol=1e-5)


def pixels(seed, count=200):
    """Rays (n, 3) float32, inverse ranges and weights (n,) of random pixels near a plane."""
    random = np.random.default_rng(seed)
    rays = np.column_stack([random.uniform(-0.6, 0.6, (count, 2)), np.ones(count)])
    rays = rays.astype(np.float32)
    inverse = rays @ random.uniform(0.1, 0.6, 3) + random.normal(0, 0.01, count)
    return rays, inverse, random.uniform(0.5, 4, count)


def moments_of(rays, inverse, weight):
    rays = rays.astype(float)
    square = np.einsum('n,ni,nj->ij', weight, rays, rays)[np.triu_indices(3)]
    sums = [*square, *(weight * inverse) @ rays, weight @ inverse**2, len(rays)]
    return np.pad(sums, (0, SIZE - len(sums)))


@pytest.mark.parametrize('seed', range(5))
def test_fit_is_weighted_least_squares(seed):
    rays, inverse, weight = pixels(seed)
    root = np.sqrt(weight)
    expected, residual, _, _ = np.linalg.lstsq(root[:, None] * rays, root * inverse, rcond=None)
    (theta,), (chi2,) = fit_all(moments_of(rays, inverse, weight)[None])
    np.testing.assert_allclose(theta, expected, rtol=1e-6)
    assert chi2 == pytest.approx(residual[0], rel=1e-6)


@pytest.mark.parametrize('case', ['nothing', 'two pixels', 'a line'])
def test_pixels_that_determine_no_plane(case):
    rays, inverse, weight = pixels(8, 0 if case == 'nothing' else 40)
    if case == 'a line':
        rays[:, 1] = 0.5 * rays[:, 0] - 0.125
    elif case == 'two pixels':
        rays[:] = rays[np.arange(40) % 2]
    moments = moments_of(rays, inverse, weight)
    theta, chi2 = fit_all(np.stack([moments, moments_of(*pixels(9))]))
    assert not theta[0].any() and theta[1].any()
    assert chi2[0] == moments[CHI2]


def image_of(depth):
    height, width = np.shape(depth)
    return RangeImage.from_depth(np.array(depth, float), Camera(width, height, 10.0, 10.0, 0, 0))


def test_measurements_are_linked_but_across_jumps():
    horizontal, vertical = grid_of(image_of([[1, 1, 0], [1, 1, 1]]))
    assert horizontal.dtype == vertical.dtype == np.bool_
    assert (horizontal.tolist(), vertical.tolist()) == ([[1, 0], [1, 1]], [[1, 1, 0]])
    jumps = np.array([[True, False], [False, False]]), np.array([[False, False, True]])
    horizontal, vertical = grid_of(image_of(np.ones((2, 3))), jumps)
    assert (horizontal.tolist(), vertical.tolist()) == ([[0, 1], [1, 1]], [[1, 1, 0]])
