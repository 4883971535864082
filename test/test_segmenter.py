"""Method normals from depth to planes: noise-free rooms, options, the fast minimiser, outputs."""

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.by_normals.labelling import (
    _nearest_directions,
    data_costs,
    degrees,
    label_costs,
    minimise,
    minimise_exactly,
)
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.label_files import as_truth
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera

NORMALS = Config(method='normals')
# Without noise neither a wide baseline nor much smoothing is called for.
NOISE_FREE = replace(NORMALS, normal_baseline=1, smoothness=20.0, edge_step=0.0065)
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
CORNER = np.array([(0, -0.8, -0.6), (-0.8, 0.36, -0.48), (0.8, 0.36, -0.48)])


def corner():
    """Depth in metres of a floor and two walls."""
    return 1 / (CAMERA.rays.astype(float) @ CORNER.T / (-1.0, -1.4, -1.2)).max(axis=2)


def segment(depth, config=NORMALS, camera=CAMERA):
    return Segmenter(config).segment(RangeImage.from_depth(depth, camera))


def test_a_bent_wall_of_two_directions_is_two_labels_and_one_plane():
    """Its halves differ by a tenth of a degree, and the nearest directions are two."""
    known = directions(NORMALS.direction_count)
    towards = known[known[:, 2] < -0.9]
    first, second = towards[np.argsort(-(towards @ towards[0]))[:2]]
    across = (second - first) / np.linalg.norm(second - first)
    left = CAMERA.rays @ across < 0
    halves = [first + second + sign * 0.002 * across for sign in (-1, 1)]
    one, other = (np.linalg.norm(n) / 2 / (-CAMERA.rays @ n.astype(float)) for n in halves)
    result = segment(2 * np.where(left, one, other), replace(NORMALS, smoothness=0.01))
    assert len(np.unique(result.labelling.labels[10:-10, 10:-10])) == 2
    assert len(result.planes) == 1 and (result.labels > 0).mean() > 0.98


@pytest.mark.parametrize('seed', range(4))
def test_faces_of_a_noise_free_room_are_found(seed):
    """Of 500 pixels, all but those thinner than the 9 pixels that jump edges look at."""
    frame = simulate(kinect_room(seed), Kinect(0, 'none'), seed=seed)
    result = segment(frame.depth, NOISE_FREE, frame.camera)
    overlap = as_truth(frame.labels, 500).compare(result.labels)
    matches = classify(overlap, 0.8).matches
    assert len(matches) >= max(8, len(overlap.truth) - 1)
    truth, found = ({p.label: p for p in planes} for planes in (frame.planes, result.planes))
    for one, other in matches.items():
        # Pixels of other faces tilt a plane.
        if np.mean(frame.labels[result.labels == other] == one) >= 0.99:
            assert np.degrees(np.arccos(min(1.0, found[other].normal @ truth[one].normal))) < 0.3
            assert found[other].distance == pytest.approx(truth[one].distance, abs=0.01)


OPTIONS = {'jump_edges': 'sobel'}, {'jump_edges': 'none'}, {'exact': True, 'direction_count': 73}
OPTIONS += {'normals': 'plane_fit'}, {'normal_baseline': 1}, {'direction_count': 17}
OPTIONS += ({'dithering': 0.001},)


@pytest.mark.parametrize('options', OPTIONS, ids=str)
def test_every_option_finds_the_corner(options):
    result = segment(corner(), replace(NORMALS, **options))
    large = [plane for plane in result.planes if plane.count > 300]
    assert len(large) == 3
    cosines = np.array([plane.normal for plane in large]) @ CORNER.T
    assert (cosines.max(axis=0) > np.cos(np.radians(2))).all()


@pytest.mark.parametrize('config', [Config(min_pixels=100), NORMALS], ids=['planes', 'normals'])
def test_a_result_can_be_pickled_with_its_energy(config):
    result = segment(corner(), config)
    data = pickle.dumps(result)
    assert len(data) < 100_000  # not with the image
    copy = pickle.loads(data)
    assert copy.image is None and (copy.energy, copy.verdict) == (result.energy, result.verdict)
    for name in ('labels', 'normals', 'terrain', 'height'):
        np.testing.assert_array_equal(getattr(copy, name), getattr(result, name))
    for one, other in zip(copy.planes, result.planes, strict=True):
        np.testing.assert_array_equal(one.hull, other.hull)
        np.testing.assert_array_equal(one.covariance, other.covariance)
    assert replace(copy, planes=[]).energy == result.energy
    # Found when it is asked for, here or in another process.
    for found in (result, copy):
        assert found.tilt.degrees == pytest.approx(np.degrees(np.arccos(0.8)), abs=1)


DIRECTIONS = directions(73).astype(np.float32)


def connected(height, width):
    return Grid(np.ones((height, width - 1), bool), np.ones((height - 1, width), bool))


def test_energy_is_close_to_that_of_the_full_expansion():
    """1 % is the package's promise, of rooms."""
    camera = kinect_camera(320, 240)
    depth = simulate(kinect_room(5), Kinect(0), camera, seed=5).depth
    configs = (replace(NORMALS, direction_count=73, exact=exact) for exact in (False, True))
    fast, full = (segment(depth, config, camera).energy for config in configs)
    assert full <= fast <= 1.01 * full


def test_noise_free_patches_are_found_to_the_pixel():
    """Rectangles about as large as the smallest plane, with holes."""
    random = np.random.default_rng(3)
    rows = np.searchsorted((19, 43), np.arange(75), side='right')
    label = 4 * rows[:, None] + np.searchsorted((25, 42, 71), np.arange(101), side='right')
    normals = DIRECTIONS[random.permutation(len(DIRECTIONS))[:12]][label]
    normals[random.random(label.shape) < 0.05] = np.nan
    arguments = normals, DIRECTIONS, connected(*label.shape), 40.0
    arguments[2].right[10:60, 50] = 0
    known = np.isfinite(normals[..., 0])
    found = minimise(*arguments)
    assert len(np.unique(np.stack([found[known], label[known]]), axis=1).T) == 12
    np.testing.assert_array_equal(found[known], minimise_exactly(*arguments)[known])


def test_the_first_of_the_nearest_directions_is_taken():
    normals = np.random.default_rng(1).normal(size=(6, 7, 3)).astype(np.float32)
    normals[0], normals[1] = 0, np.nan
    expected = (np.nan_to_num(normals) @ DIRECTIONS.T).argmax(axis=2)
    np.testing.assert_array_equal(_nearest_directions(normals, DIRECTIONS), expected)


def test_costs_of_squares_are_sums_of_angles():
    random = np.random.default_rng(1)
    normals, label = random.normal(size=(8, 8, 3)), random.integers(0, 73, (2, 2), np.int32)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    normals[6:], normals[:, 7:] = np.nan, np.nan  # outside of the image
    angles = np.degrees(np.arccos((normals * DIRECTIONS[label].repeat(4, 0).repeat(4, 1)).sum(2)))
    expected = np.nansum(angles.reshape(2, 4, 2, 4), axis=(1, 3))
    arguments = 4, normals[:6, :7].astype(np.float32), DIRECTIONS
    np.testing.assert_allclose(data_costs(label, *arguments), expected, rtol=1e-5)
    for k, each in np.ndenumerate(label):
        found = label_costs(each, np.arange(4, dtype=np.int32), *arguments)
        assert found.reshape(2, 2)[k] == pytest.approx(expected[k], rel=1e-5)


def test_angles_of_the_kernel_are_those_of_the_arc_cosine():
    cosines = np.append(np.linspace(-1, 1, 501), [1 + 1e-7, -1 - 1e-7]).astype(np.float32)
    expected = np.degrees(np.arccos(np.clip(cosines.astype(float), -1, 1)))
    np.testing.assert_allclose([degrees(cosine) for cosine in cosines], expected, atol=1e-4)
    assert degrees(np.float32(np.nan)) == 0


def test_pixels_without_normal_belong_to_their_side_of_a_jump():
    """A jump within a block, pixels without normal beside it: the prior alone places them."""
    normals = np.empty((64, 64, 3), np.float32)
    normals[:, :35], normals[:, 35:] = DIRECTIONS[5], DIRECTIONS[40]
    normals[:, 32:38] = np.nan
    grid = connected(64, 64)
    grid.right[:, 34] = 0
    found = minimise(normals, DIRECTIONS, grid, 100.0)
    assert (found[:, :35] == 5).all() and (found[:, 35:] == 40).all()


KINECT = kinect_camera(160, 120)


@pytest.fixture(scope='module')
def room():
    return simulate(kinect_room(3), Kinect(0, 'none'), KINECT)


@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_normals_are_those_of_the_surfaces(room, method):
    # Smoothness for so small an image.
    result = segment(room.depth, Config(method=method, min_pixels=100, smoothness=30.0), KINECT)
    normals, known = result.normals, result.labels > 0
    assert normals.dtype == np.float32 and normals.shape == (120, 160, 3)
    np.testing.assert_array_equal(np.isfinite(normals).all(axis=2), known)
    np.testing.assert_allclose(np.linalg.norm(normals[known], axis=1), 1, atol=1e-6)
    truth = np.full((room.labels.max() + 1, 3), np.nan)
    for plane in room.planes:
        truth[plane.label] = plane.normal
    cosine = (truth[room.labels] * normals).sum(axis=2)
    angle = np.degrees(np.arccos(np.minimum(cosine[known & np.isfinite(cosine)], 1)))
    # Of 305 directions, the nearest is at most 4.7 degrees away.
    assert np.mean(angle < (0.1 if method == 'planes' else 5.0)) > 0.94
    if method == 'normals':
        found = np.unique(normals[known], axis=0)[:, None]
        assert (found == directions(305).astype(np.float32)).all(axis=2).any(axis=1).all()


def test_edges_lie_on_both_sides_of_jumps():
    depth, expected = np.full(KINECT.shape, 2.0), np.zeros(KINECT.shape, bool)
    depth[:, 80:], expected[:, 79:81] = 1.5, True
    for config, edges in ((Config(), expected), (Config(jump_edges='none'), 0 * expected)):
        np.testing.assert_array_equal(segment(depth, config, KINECT).edges, edges)


def test_segment_writes_normals_as_red_green_blue(tmp_path, room, run):
    write_image(tmp_path / 'a.tiff', room.depth)
    write_camera(tmp_path / 'camera.yaml', KINECT)
    command = 'segment', tmp_path / 'a.tiff', '--camera', tmp_path / 'camera.yaml', '--output'
    assert run(*command, tmp_path, '--normals')[0] == run(*command, tmp_path / 'plain')[0] == 0
    assert not (tmp_path / 'plain/a_normals.tiff').exists()
    # OpenCV reads blue, green, red.
    written = cv2.imread(str(tmp_path / 'a_normals.tiff'), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(written, segment(room.depth, Config(), KINECT).normals)


def test_messages_hold_normals_and_edges(room):
    result = segment(room.depth, Config(min_pixels=100), KINECT)
    normals, edges = (
        OUTPUTS[name].message(lambda kind, **fields: fields, None, result.image, result)
        for name in ('normals', 'edges')
    )
    assert (normals['encoding'], normals['step'], edges['encoding']) == ('32FC3', 1920, 'mono8')
    sent = normals['data'].view('<f4').reshape(120, 160, 3)
    np.testing.assert_array_equal(sent, result.normals)
    np.testing.assert_array_equal(edges['data'].reshape(120, 160) == 255, result.edges)
