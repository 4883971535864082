"""The same frame and parameters give the same bits: any threads, any process, compiled or not."""

import json
import os
import subprocess
import sys

import cv2
import pytest
from hard_inputs import digest

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.core.runtime.work import STEPS
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

CASES = [{}, {'method': 'normals'}, *({'work_budget': step} for step in STEPS[1:])]


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


@pytest.mark.parametrize('threads', [1, 2, 5])
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


def labels_and_planes():
    """Of both methods, the slower one on a smaller image."""
    told = []
    for method, width in (('planes', 160), ('normals', 64)):
        camera = kinect_camera(width, width * 3 // 4)
        frame = simulate_kinect(kinect_room(903), camera, seed=903, sensor_seed=903)
        config = Config(method=method, direction_count=73, min_pixels=width * width // 256)
        result = Segmenter(config).segment(RangeImage.from_depth(frame.depth, camera))
        planes = [[p.label, p.count, *p.normal.tolist(), p.distance] for p in result.planes]
        told.append([result.labels.tolist(), planes])
    return told


def test_compiled_code_gives_what_the_plain_python_gives():
    here = labels_and_planes()
    assert min(len(planes) for _, planes in here) >= 5
    assert in_another_process(labels_and_planes, NUMBA_DISABLE_JIT='1') == here
