"""Kernels compiled ahead: all that frames need, nothing else, by processes that do not collide."""

import os
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from multiprocessing import get_context

import numpy as np
import pytest
from clouds import cloud_of
from numba import types
from processes import python

from rangeseg_ros import Config, RangeImage
from rangeseg_ros.compilation import preparation
from rangeseg_ros.compilation.preparation import FIRST, KINDS, needs, prepare, rehearse
from rangeseg_ros.compilation.worker import discover
from rangeseg_ros.core.runtime.kernels import nothing_compiled
from rangeseg_ros.core.runtime.work import STEPS
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.sensors.kinect import kinect_camera


def silent(progress):
    """No progress shown."""


@cache
def found_by_a_process(*rehearsed):
    """Kernels that `rehearse(*rehearsed)` needs; discovery leaves its process interpreted."""
    with get_context('spawn').Pool(1) as pool:
        return pool.apply(discover, (partial(rehearse, *rehearsed),))


@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_frames_need_nothing_more(method):
    """Of any size, as clouds, and with less of the work, which changes while frames come."""
    config = Config(method=method)
    prepare(config, report=silent)
    budgets = [replace(config, work_budget=step) for step in STEPS[1:] if method == 'planes']
    for shape, configs in (((24, 32), [config]), ((121, 212), [config, *budgets])):
        camera = kinect_camera(*shape[::-1])
        x, y = camera.rays[..., 0], camera.rays[..., 1]
        depth = np.where(y > 0.2, 0.6 / np.maximum(y, 0.2), 3 - np.hypot(x, y))
        depth += np.random.default_rng(0).normal(0, 0.002, shape)
        depth[:, ::17] = np.nan
        image = RangeImage.from_depth(depth, camera)
        with nothing_compiled():
            for each in (image, cloud_of(image.points)):
                for chosen in configs:
                    SequenceSegmenter(chosen).segment(each, 0)


def named(kind):
    """Whether values of a type of numba's contain a named tuple."""
    if isinstance(kind, types.Optional):
        return named(kind.type)
    if not isinstance(kind, types.BaseTuple):
        return False
    return isinstance(kind, types.BaseNamedTuple) or any(map(named, kind))


@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_what_is_found_is_what_a_run_compiles(method):
    """And none returns a named tuple to Python.

    The compiled code makes one by calls of Python, in which signal handlers run. Where one
    raises, as that of Ctrl-C does, Python 3.12 and later crash.
    """
    config = Config(method=method)
    found = found_by_a_process(config, KINDS)
    assert len(found) > 20
    # None twice only because an array may be written to here and not there.
    kinds = [(k.name, str(k.signature).replace('True', 'False')) for k in found]
    assert len(set(kinds)) == len(kinds)
    rehearse(config)
    for kernel in found:
        compiled = getattr(import_module(kernel.module), kernel.name).overloads
        assert kernel.signature in compiled, kernel.name
        assert not named(compiled[kernel.signature].signature.return_type), kernel.name


def test_labels_and_planes_need_less():
    """They come first: without the terrain, and all that they need."""
    first = {kernel[:3] for kernel in found_by_a_process(Config(), ('image',), FIRST)}
    assert first < {kernel[:3] for kernel in found_by_a_process(Config(), KINDS)}
    assert not any('.ground.' in module for module, *_ in first)


def test_without_processes_it_is_compiled_all_the_same(monkeypatch):
    told = []
    monkeypatch.setattr(preparation.sys, 'executable', '/bin/false')
    preparation._compile(told.append, Config(), KINDS)
    assert not told


FIRST_FRAME = """
import sys
from rangeseg_ros.compilation import preparation

def compiled(report, *rehearsed):
    report('compiling kernels, 1 of 2')
    sys.exit(f'{rehearsed[1]}, {rehearsed[0].method}')

preparation._compile = compiled
from rangeseg_ros import Camera, Config, RangeImage, Segmenter
import numpy as np
image = RangeImage.from_depth(np.full((48, 64), 2.0), Camera.from_fov(64, 48, 57))
Segmenter(Config(method='normals')).segment(image)
"""


def test_the_first_frame_says_that_kernels_are_compiled(tmp_path):
    """In Python, without the command line, as the configuration needs them."""
    environment = {**os.environ, 'NUMBA_CACHE_DIR': os.fspath(tmp_path)}
    run = python(FIRST_FRAME, env=environment)
    begin = 'rangeseg_ros: compiling kernels, once after the installation'
    assert run.stderr.splitlines() == [begin, "('image',), normals"]


def test_a_terminal_shows_a_bar(monkeypatch, capsys):
    monkeypatch.setattr(preparation.sys.stderr, 'isatty', lambda: True, raising=False)
    for progress in ('compiling kernels', 'compiling kernels, 3 of 6'):
        preparation.show(progress)
    before, after = capsys.readouterr().err.split('\r')[:2]
    assert '#' not in before and after.count('#') == preparation._WIDTH // 2


def test_needs_follow_choices_and_switches_but_not_sizes():
    assert needs(Config(min_pixels=9)) == needs(Config(min_pixels=7, noise=0.5))
    assert needs(Config(method='normals')) != needs(Config())
