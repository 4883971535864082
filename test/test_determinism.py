"""The same frame and parameters give the same bits: any threads, any process, compiled or not."""

import hashlib
import json
import os
import subprocess
import sys
import warnings

import cv2
import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.runtime.work import STEPS
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

CASES = [{}, {'method': 'normals'}, *({'work_budget': step} for step in STEPS[1:])]
SHAPES = [(1, 1), (1, 2), (2, 1), (1, 97), (97, 1), (2, 2), (3, 3), (5, 64), (17, 33), (37, 49)]


@pytest.fixture(scope='module')
def digests():
    return all_digests()


def all_digests():
    """Of labels, planes, normals, terrain and heights of a room, for each case."""
    scene = kinect_room(903)
    frame = simulate_kinect(scene, kinect_camera(161, 121), seed=903)
    image, up = RangeImage.from_depth(frame.depth, frame.camera), scene.poses[0].rotation[2]
    configs = [Config(min_pixels=100, **case) for case in CASES]
    return [digest(SequenceSegmenter(config).segment(image, 0, up)) for config in configs]


def digest(result):
    """Of all that is told of a frame."""
    told = [result.labels, result.terrain, result.height, result.normals]
    told += [part for p in result.planes for part in (p.normal, p.covariance, p.hull)]
    return hashlib.sha256(b''.join(part.tobytes() for part in told)).hexdigest()


@pytest.mark.parametrize('threads', [1, 5])
def test_any_number_of_threads_gives_the_same_bits(digests, threads):
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        assert all_digests() == digests
    finally:
        cv2.setNumThreads(before)


def in_another_process(function, **environment):
    """What a function of this module returns there."""
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), **environment}
    code = f'import json, test_determinism as t; print(json.dumps(t.{function.__name__}()))'
    return json.loads(subprocess.check_output([sys.executable, '-c', code], env=environment))


def test_another_process_gives_the_same_bits(digests):
    assert in_another_process(all_digests, PYTHONHASHSEED='7') == digests
    assert len(set(digests)) == len(CASES)


def rooms():
    """Labels and planes of both methods, of the slower one in a smaller image."""
    for method, width in (('planes', 160), ('normals', 64)):
        camera = kinect_camera(width, width * 3 // 4)
        frame = simulate_kinect(kinect_room(903), camera, seed=903, sensor_seed=903)
        config = Config(method=method, direction_count=73, min_pixels=width * width // 256)
        result = Segmenter(config).segment(RangeImage.from_depth(frame.depth, camera))
        planes = [[p.label, p.count, *p.normal.tolist(), p.distance] for p in result.planes]
        yield method, result.labels.tolist(), planes


def depths(shape):
    """Depth images (H, W) at the limits of indices, holes and values."""
    random = np.random.default_rng(shape[0] * 1000 + shape[1])
    v, u = np.indices(shape, float)
    planes = np.where(u > v, 1 + 0.01 * u, 2 - 0.01 * v)
    noisy = planes + random.normal(0, 0.003, shape)
    last = (v == shape[0] - 1) & (u == shape[1] - 1)
    return {
        'nothing': np.full(shape, np.nan),
        'constant': np.ones(shape),
        'last pixel': np.where(last, 1.0, np.nan),
        'border': np.where((v % max(shape[0] - 1, 1) == 0), 1.0, np.nan),
        'chequered': np.where((u + v) % 2, 1.0, 5.0),
        'lines': np.where(v % 2, 1.0, np.nan),
        'noise': random.uniform(0.1, 10, shape),
        'planes': planes,
        'holes': np.where(random.random(shape) < 0.4, np.nan, noisy),
        'stairs': 1 + 0.2 * (v // 4),
        'infinite': np.where(u % 3 == 0, np.inf, noisy),
        'near and far': np.where(u > v, 1e-6, 1e5),
        'negative': -noisy,
    }


def hard_images():
    """Labels, planes and terrain of images and clouds of any size."""
    for shape in SHAPES:
        (height, width), focal = shape, max(shape)
        camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        for name, depth in depths(shape).items():
            image = RangeImage.from_depth(depth.astype(np.float32), camera)
            for method, seen in (
                ('planes', image),
                ('planes', RangeImage.from_points(image.points)),
                ('normals', image),
            ):
                # Down the image, so that there is ground in some.
                config = Config(method=method, up_y=-1.0, up_z=0.0, min_pixels=4)
                result = SequenceSegmenter(config).segment(seen, 0)
                planes = [[p.count, *np.round(p.normal, 6).tolist()] for p in result.planes]
                told = hashlib.sha256(result.labels.tobytes() + result.terrain.tobytes())
                yield f'{shape} {name} {method}', told.hexdigest(), planes


def frames():
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        return [[*told] for told in (*rooms(), *hard_images())]


@pytest.mark.slow
def test_plain_python_gives_what_compiled_code_gives():
    """And reads and writes within arrays: NumPy checks every index, compiled code does not."""
    plain, compiled = in_another_process(frames, NUMBA_DISABLE_JIT='1'), frames()
    assert [one for one, other in zip(plain, compiled, strict=True) if one != other] == []
    assert [len(planes) >= 5 for _, _, planes in compiled[:2]] == [True, True]
