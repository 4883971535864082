"""Kernels compiled ahead: all that frames need, nothing else, by processes that do not collide."""

import os
import pickle
import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest
from clouds import cloud_of

from rangeseg_ros import Config, RangeImage
from rangeseg_ros.compilation import preparation
from rangeseg_ros.compilation.discovery import Kernel
from rangeseg_ros.compilation.preparation import needs, prepare
from rangeseg_ros.compilation.rehearsal import FIRST, KINDS, rehearse
from rangeseg_ros.core.runtime.work import STEPS
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.kinect import kinect_camera, simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room

WORKER = [sys.executable, '-m', 'rangeseg_ros.compilation.worker']


def silent(progress):
    """No progress shown."""


@pytest.fixture(scope='module')
def worker():
    """A process that finds and compiles kernels."""
    with subprocess.Popen(WORKER, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        yield process
        process.kill()


def ask(process, request):
    """Answers of a worker to a request."""
    pickle.dump(request, process.stdin)
    process.stdin.flush()
    return list(iter(lambda: pickle.load(process.stdout), None))


@pytest.mark.parametrize('method', ['planes', 'normals'])
@pytest.mark.parametrize('shape', [(24, 32), (121, 212), (480, 640)])
def test_frames_need_nothing_more(method, shape):
    config = Config(method=method)
    prepare(config, report=silent)
    height, width = shape
    camera = kinect_camera(width, height)
    x, y = camera.rays[..., 0], camera.rays[..., 1]
    depth = np.where(y > 0.2, 0.6 / np.maximum(y, 0.2), 3 - np.hypot(x, y))
    depth += np.random.default_rng(0).normal(0, 0.002, shape)
    depth[:, ::17] = np.nan
    image = RangeImage.from_depth(depth, camera)
    with preparation._nothing_compiled():
        for each in (image, cloud_of(image.points)):
            SequenceSegmenter(config).segment(each, 0)


@pytest.mark.parametrize('budget', STEPS[1:])
def test_less_of_the_work_needs_nothing_more(budget):
    """Budgets change while frames come."""
    prepare(Config(), report=silent)
    camera = kinect_camera(161, 121)
    image = RangeImage.from_depth(simulate_kinect(kinect_room(2), camera, seed=2).depth, camera)
    with preparation._nothing_compiled():
        for each in (image, cloud_of(image.points)):
            SequenceSegmenter(Config(work_budget=budget)).segment(each, 0)


def test_what_is_found_is_what_a_run_compiles(worker):
    found = ask(worker, ('discover', (Config(), KINDS)))
    assert len(found) > 20
    # None twice only because an array may be written to here and not there.
    kinds = [(k.name, str(pickle.loads(k.signature)).replace('True', 'False')) for k in found]
    assert len(set(kinds)) == len(kinds)
    rehearse(Config())
    for kernel in found:
        dispatcher = getattr(import_module(kernel.module), kernel.name)
        assert pickle.loads(kernel.signature) in dispatcher.overloads, kernel.name


def test_labels_and_planes_need_less():
    """They come first: without the terrain, and all that they need."""
    found = []
    for outputs in (FIRST, tuple(OUTPUTS)):
        with subprocess.Popen(WORKER, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            kernels = ask(process, ('discover', (Config(), ('image',), outputs)))
            found.append({(k.module, k.name, k.signature) for k in kernels})
            process.kill()
    first, every = found
    assert first < every
    assert not any('.ground.' in module for module, *_ in first)


def test_two_processes_compile_a_kernel_once(tmp_path):
    from numba import float64

    signature = pickle.dumps((float64[::1], float64[::1]))
    kernel = Kernel('rangeseg_ros.core.sensing.moments', 'fit', signature, 0)
    workers = [
        subprocess.Popen(
            WORKER,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, 'NUMBA_CACHE_DIR': os.fspath(tmp_path)},
        )
        for _ in range(2)
    ]
    for process in workers:
        pickle.dump(kernel, process.stdin)
        process.stdin.close()
    for process in workers:
        assert pickle.load(process.stdout) is None
        assert process.wait() == 0
        process.stdout.close()
    assert len(list(tmp_path.rglob('moments.fit-*.nbc'))) == 1


def test_without_processes_it_is_compiled_all_the_same(monkeypatch):
    told = []
    monkeypatch.setattr(preparation.sys, 'executable', '/bin/false')
    pool = preparation.Pool(told.append)
    pool.compile(Config(), KINDS)
    assert not told


def test_needs_follow_choices_and_switches_but_not_sizes():
    assert needs(Config(min_pixels=9)) == needs(Config(min_pixels=7, noise=0.5))
    for other in (Config(method='normals'), Config(exact=True), Config(refits=2)):
        assert needs(other) != needs(Config())
