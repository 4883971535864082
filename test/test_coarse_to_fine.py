"""The fast minimiser against the full expansion on the same energy."""

import numpy as np
import pytest

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.core.by_normals import coarse_to_fine
from rangeseg_ros.core.by_normals.angular_cost import degrees
from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.by_normals.method import minimise_exactly
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

DIRECTIONS = directions('platonic', 73).astype(np.float32)


def patches(seed, height, width, noise):
    """Normals of rectangles about as large as the smallest plane, noisy, with holes."""
    random = np.random.default_rng(seed)
    rows = np.searchsorted((19, 43), np.arange(height), side='right')
    columns = np.searchsorted((25, 42, 71), np.arange(width), side='right')
    label = 4 * rows[:, None] + columns
    truth = DIRECTIONS[random.permutation(len(DIRECTIONS))[:12]][label]
    normals = truth + noise * random.normal(size=truth.shape)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    normals[random.random((height, width)) < 0.05] = np.nan
    return normals.astype(np.float32), label


def problem(seed, height=75, width=101, noise=0.15):
    normals, label = patches(seed, height, width, noise)
    grid = connected(height, width)
    grid.right[10:60, 50] = 0
    return (normals, DIRECTIONS, grid, 40.0), label


def connected(height, width):
    right, below = np.ones((height, width - 1)), np.ones((height - 1, width))
    return Grid(right.astype(np.float32), below.astype(np.float32))


def test_energy_is_close_to_that_of_the_full_expansion():
    """1 % is the package's promise, of rooms."""
    camera = kinect_camera(320, 240)
    image = RangeImage.from_depth(simulate_kinect(kinect_room(5), camera, seed=5).depth, camera)
    fast, full = (
        Segmenter(Config(method='normals', direction_count=73, exact=exact)).segment(image).energy
        for exact in (False, True)
    )
    assert full <= fast <= 1.01 * full


def test_noise_free_patches_are_found_to_the_pixel():
    arguments, label = problem(3, noise=0.0)
    known = np.isfinite(arguments[0][..., 0])
    found = coarse_to_fine.minimise(*arguments)
    assert len(np.unique(np.stack([found[known], label[known]]), axis=1).T) == 12
    np.testing.assert_array_equal(found[known], minimise_exactly(*arguments)[known])


@pytest.mark.parametrize('shape', [(1, 1), (1, 30), (7, 9), (8, 16)])
def test_any_size_of_image(shape):
    normals = np.tile(DIRECTIONS[5].astype(np.float32), (*shape, 1))
    assert (coarse_to_fine.minimise(normals, DIRECTIONS, connected(*shape), 40.0) == 5).all()


def test_angles_of_the_kernel_are_those_of_the_arc_cosine():
    cosines = np.append(np.linspace(-1, 1, 501), [1 + 1e-7, -1 - 1e-7]).astype(np.float32)
    found = [degrees(cosine) for cosine in cosines]
    expected = np.degrees(np.arccos(np.clip(cosines.astype(float), -1, 1)))
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert degrees(np.float32(np.nan)) == 0


def test_pixels_without_normal_belong_to_their_side_of_a_jump():
    """A jump within a block, pixels without normal beside it: the prior alone places them."""
    normals = np.empty((64, 64, 3), np.float32)
    normals[:, :35], normals[:, 35:] = DIRECTIONS[5], DIRECTIONS[40]
    normals[:, 32:38] = np.nan
    grid = connected(64, 64)
    grid.right[:, 34] = 0
    found = coarse_to_fine.minimise(normals, DIRECTIONS, grid, 100.0)
    assert (found[:, :35] == 5).all() and (found[:, 35:] == 40).all()
