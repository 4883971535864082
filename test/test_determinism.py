"""The same bits with any threads, in any process, compiled or not; work in threads."""

import hashlib
import json
import multiprocessing
import os
import sys
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from processes import python

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.runtime.threads import Task, map_halves, sharing_cores
from rangeseg_ros.core.sensing.binning import BUDGETS
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera

CASES = [{}, {'method': 'normals'}, *({'work_budget': step} for step in BUDGETS[1:])]
SHAPES = [(1, 1), (1, 2), (2, 1), (1, 97), (97, 1), (2, 2), (3, 3), (5, 64), (17, 33), (37, 49)]


@pytest.fixture(scope='module')
def digests():
    return all_digests()


def all_digests():
    """Of labels, planes, normals, terrain and heights of a room, for each case."""
    scene = kinect_room(903)
    frame = simulate(scene, Kinect(0), kinect_camera(161, 121), seed=903)
    image, up = RangeImage.from_depth(frame.depth, frame.camera), scene.poses[0].rotation[2]
    configs = [Config(min_pixels=100, **case) for case in CASES]
    return [digest(SequenceSegmenter(config).segment(image, 0, up)) for config in configs]


def digest(result):
    """Of all that is told of a frame."""
    told = [result.labels, result.terrain, result.height, result.normals]
    told += [part for p in result.planes for part in (p.normal, p.covariance, p.hull)]
    return hashlib.sha256(b''.join(part.tobytes() for part in told)).hexdigest()


@pytest.fixture(params=[1, 2, 7])
def threads(request):
    before = cv2.getNumThreads()
    cv2.setNumThreads(request.param)
    yield request.param
    cv2.setNumThreads(before)


@pytest.mark.parametrize('threads', [1, 5], indirect=True)
def test_any_number_of_threads_gives_the_same_bits(digests, threads):
    assert all_digests() == digests


def in_another_process(function, **environment):
    """What a function of this module returns there."""
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), **environment}
    code = f'import json, test_determinism as t; print(json.dumps(t.{function.__name__}()))'
    return json.loads(python(code, env=environment).stdout)


def test_another_process_gives_the_same_bits(digests):
    assert in_another_process(all_digests, PYTHONHASHSEED='7') == digests
    assert len(set(digests)) == len(CASES)


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


def images():
    """Rooms, that of the slower method smaller, and images and clouds of any size."""
    for method, width in (('planes', 160), ('normals', 64)):
        camera = kinect_camera(width, width * 3 // 4)
        frame = simulate(kinect_room(903), Kinect(903), camera, seed=903)
        config = Config(method=method, direction_count=73, min_pixels=width * width // 256)
        yield method, config, RangeImage.from_depth(frame.depth, camera)
    # Down the image, so that there is ground in some.
    config = Config(up_y=-1.0, up_z=0.0, min_pixels=4)
    for shape in SHAPES:
        (height, width), focal = shape, max(shape)
        camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        for name, depth in depths(shape).items():
            image = RangeImage.from_depth(depth.astype(np.float32), camera)
            yield f'{shape} {name}', config, image
            yield f'{shape} {name}, cloud', config, RangeImage.from_points(image.points)
            yield f'{shape} {name}, normals', replace(config, method='normals'), image


def frames():
    """What is told of each image: its name, labels and terrain as a digest, and planes."""
    frames = []
    for name, config, image in images():
        result = SequenceSegmenter(config).segment(image, 0)
        told = hashlib.sha256(result.labels.tobytes() + result.terrain.tobytes()).hexdigest()
        digits = 6 if 'far' in name else 16  # at 100 km, the others follow the order of sums
        planes = ([*p.normal, 1 / p.distance, p.count] for p in result.planes)
        frames.append([name, told, np.round([*planes], digits).tolist()])
    return frames


@pytest.mark.slow
@pytest.mark.filterwarnings('ignore')
def test_plain_python_gives_what_compiled_code_gives():
    """And reads and writes within arrays: NumPy checks every index, compiled code does not."""
    plain, compiled = in_another_process(frames, NUMBA_DISABLE_JIT='1'), frames()
    assert [one for one, other in zip(plain, compiled, strict=True) if one != other] == []
    assert min(len(planes) for _, _, planes in compiled[:2]) >= 5


def test_halves_do_not_depend_on_the_number_of_threads(threads):
    for rows in range(10):
        upper, lower = map_halves(lambda *given: given, rows, 'x')
        assert upper == (0, rows // 2, 'x') and lower == (rows // 2, rows, 'x')


@pytest.mark.parametrize('threads', [2, 7], indirect=True)
def test_halves_are_worked_on_at_the_same_time(threads):
    """They wait for each other; alone they would for ever."""
    barrier = threading.Barrier(2, timeout=20)
    map_halves(lambda first, after: barrier.wait(), 1000)


@pytest.mark.parametrize('threads', [2], indirect=True)
def test_frames_with_a_core_each_have_no_helpers(threads):
    def worker():
        """Who does a task: another thread, given the time to begin it."""
        begun = threading.Event()
        task = Task(lambda: (threading.get_ident(), begun.set()))
        begun.wait(0.5)
        return task.result()[0]

    me = threading.get_ident()
    with sharing_cores():
        assert worker() != me
        with sharing_cores():
            assert worker() == me
        assert worker() != me
    with pytest.raises(ValueError), sharing_cores(), sharing_cores():
        raise ValueError
    assert worker() != me


@pytest.mark.parametrize('threads', [2], indirect=True)
def test_a_task_that_waits_for_a_helper_is_done_by_who_needs_it(threads):
    """The only helper is at work for as long as the other task is not done."""
    begun, free = threading.Event(), threading.Event()
    busy = Task(lambda: (begun.set(), free.wait(20)))
    assert begun.wait(20)
    assert Task(threading.get_ident).result() == threading.get_ident()
    free.set()
    assert busy.result() == (None, True)


@pytest.mark.parametrize('threads', [2], indirect=True)
def test_tasks_may_have_tasks(threads):
    """Also where no helper is free for them."""

    def depth(left):
        return 1 + max(Task(depth, left - 1).result() for _ in range(2)) if left else 0

    assert depth(5) == 5


def test_a_program_ends_after_its_tasks():
    """A kernel that is at work when the interpreter is gone may bring down the process."""
    program = (
        'import time, cv2; from rangeseg_ros.core.runtime.threads import Task\n'
        'cv2.setNumThreads(2); Task(lambda: (time.sleep(0.5), print("over", flush=True)))\n'
        'time.sleep(0.1)'
    )
    ended = python(program)
    assert (ended.returncode, ended.stdout) == (0, 'over\n')


def test_errors_come_back():
    with pytest.raises(ValueError, match='half from 0'):
        map_halves(lambda first, after: int(f'half from {first}'), 100)
    with pytest.raises(ValueError, match='late'):
        Task(lambda: (time.sleep(0.05), int('late'))).result()


@pytest.mark.skipif('fork' not in multiprocessing.get_all_start_methods(), reason='no fork')
@pytest.mark.parametrize('threads', [2], indirect=True)
def test_threads_are_started_anew_in_a_forked_process(threads):
    def meet():
        barrier = threading.Barrier(2, timeout=20)
        queue.put(sorted(map_halves(lambda first, after: barrier.wait(), 100)))

    context = multiprocessing.get_context('fork')
    queue = context.Queue()
    child = context.Process(target=meet, daemon=True)
    for begin in (meet, child.start):
        begin()
        assert queue.get(timeout=30) == [0, 1]
    child.join()
