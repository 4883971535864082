"""Method `normals` from depth to planes: noise-free rooms, degenerate frames, determinism."""

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room

NORMALS = Config(method='normals')
# Without noise neither a wide baseline nor much smoothing is called for.
NOISE_FREE = replace(
    NORMALS, normal_baseline=1, smoothness=20.0, noise_regions='leave', edge_step=0.0065
)
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def corner(noise=0.0):
    """Depth in metres of a floor and two walls."""
    rays = CAMERA.rays.astype(float)
    planes = [((0, -0.8, -0.6), 1.0), ((-0.8, 0.36, -0.48), 1.4), ((0.8, 0.36, -0.48), 1.2)]
    inverse = np.max([rays @ n / -d for n, d in planes], axis=0)
    return 1 / inverse + noise * np.random.default_rng(0).normal(size=CAMERA.shape)


def segment(depth, config=NORMALS, camera=CAMERA):
    return Segmenter(config).segment(RangeImage.from_depth(depth, camera))


@pytest.mark.parametrize('seed', range(4))
def test_every_face_of_a_noise_free_room_is_found(seed):
    """Faces of 500 pixels that are nowhere thinner than the 9 pixels jump edges look at."""
    frame = simulate_kinect(kinect_room(seed), noise='none', seed=seed)
    result = segment(frame.depth, NOISE_FREE, frame.camera)
    checked = 0
    for plane in frame.planes:
        face = frame.labels == plane.label
        thick = cv2.erode(face.astype(np.uint8), np.ones((9, 9), np.uint8)).any()
        if face.sum() < 500 or not thick:
            continue
        counts = np.bincount(result.labels[face], minlength=len(result.planes) + 1)
        counts[0] = 0
        label = int(counts.argmax())
        assert counts[label] >= 0.8 * face.sum(), plane
        assert counts[label] >= 0.8 * (result.labels == label).sum(), plane
        found = next(p for p in result.planes if p.label == label)
        assert np.degrees(np.arccos(min(1.0, found.normal @ plane.normal))) < 0.3
        assert found.distance == pytest.approx(plane.distance, abs=0.01)
        checked += 1
    assert checked >= 8


def test_exact_goes_on_until_no_move_helps():
    swap = replace(NORMALS, exact=True, moves='swap', direction_count=17, normal_baseline=1)
    energies = [
        segment(corner(0.1), replace(swap, smoothness=60.0, **rounds)).energy
        for rounds in ({'cycles': 5}, {}, {'cycles': 1000})
    ]
    assert energies[0] > energies[1] == energies[2]


@pytest.mark.parametrize(
    'options',
    [
        {'normals': 'plane_fit'},
        {'normal_baseline': 1},
        {'directions': 'regular', 'direction_count': 225},
        {'directions': 'spiral', 'direction_count': 300},
        {'directions': 'random', 'direction_count': 500},
        {'jump_edges': 'sobel'},
        {'jump_edges': 'none'},
        {'weighting': 'distance'},
        {'exact': True, 'moves': 'swap', 'direction_count': 73},
        {'noise_regions': 'leave'},
        {'noise_regions': 'merge'},
        {'dithering': 0.001},
    ],
    ids=lambda options: ' '.join(f'{name}={value}' for name, value in options.items()),
)
def test_every_option_finds_the_corner(options):
    result = segment(corner(), replace(NORMALS, **options))
    large = [plane for plane in result.planes if plane.count > 300]
    assert len(large) == 3
    truth = np.array([(0, -0.8, -0.6), (-0.8, 0.36, -0.48), (0.8, 0.36, -0.48)])
    angles = np.degrees(np.arccos(np.clip(np.array([p.normal for p in large]) @ truth.T, -1, 1)))
    assert (angles.min(axis=0) < 2).all()


@pytest.mark.parametrize('config', [Config(min_pixels=100), NORMALS], ids=['planes', 'normals'])
def test_a_result_can_be_pickled_with_its_energy(config):
    result = segment(corner(), config)
    data = pickle.dumps(result)
    assert len(data) < 100_000  # not with the image
    copy = pickle.loads(data)
    assert copy.image is None
    assert (copy.energy, copy.verdict) == (result.energy, result.verdict)
    for name in ('labels', 'normals', 'terrain', 'height'):
        np.testing.assert_array_equal(getattr(copy, name), getattr(result, name))
    for one, other in zip(copy.planes, result.planes, strict=True):
        np.testing.assert_array_equal(one.hull, other.hull)
        np.testing.assert_array_equal(one.covariance, other.covariance)
    assert replace(copy, planes=[]).energy == result.energy


def noisy(seed):
    return corner() + 0.01 * np.random.default_rng(seed).normal(size=CAMERA.shape)


def image(seed, camera=CAMERA):
    return RangeImage.from_depth(noisy(seed), camera)


def test_frames_do_not_depend_on_each_other():
    segmenter = Segmenter(NORMALS)
    for seed in (1, 2, 1):
        assert np.array_equal(segmenter.segment(image(seed)).labels, segment(noisy(seed)).labels)


def test_a_tilt_is_found_when_asked_for_here_or_in_another_process():
    result = segment(corner())
    sent = pickle.loads(pickle.dumps(result))
    for found in (result, sent):
        assert found.tilt.degrees == pytest.approx(np.degrees(np.arccos(0.8)), abs=1)
    sequence = SequenceSegmenter(NORMALS)
    image = RangeImage.from_depth(corner(), CAMERA)
    assert sequence.segment(image, 0).tilt is not None
    assert sequence.segment(image, 1, up=(0, -0.8, -0.6)).tilt is None
