"""Compiled kernels: made ahead, by whom, kept where that is possible, dropped when outdated."""

import functools
import os
import re
import sys
from dataclasses import replace
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from clouds import cloud_of
from processes import python

from rangeseg_ros import Config, RangeImage
from rangeseg_ros import kernel_cache as cache
from rangeseg_ros.compilation import preparation
from rangeseg_ros.compilation.preparation import FIRST, KINDS, _compile, needs, prepare, rehearse
from rangeseg_ros.compilation.worker import discover
from rangeseg_ros.core.runtime.kernels import nothing_compiled
from rangeseg_ros.core.sensing.binning import BUDGETS
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]

# Nothing but the folder given may be written to; numba and we try that with a temporary file.
RESTRICT = """
import sys, tempfile
allowed, real = sys.argv.pop(), tempfile.TemporaryFile

def temporary_file(*arguments, dir=None, **options):
    if not allowed or not str(dir).startswith(allowed):
        raise PermissionError(13, 'Permission denied')
    return real(*arguments, dir=dir, **options)

tempfile.TemporaryFile = temporary_file
tempfile.tempdir = allowed or '/proc'
"""
KERNEL = 'from rangeseg_ros.core.by_normals.labelling import degrees\ndegrees(1.0)'
# Prints when it is unpickled, as numba does with what it finds.
CODE_IN_A_PICKLE = 2 * b"cbuiltins\nprint\n(S'poison'\ntR."
KEPT, CACHE = 'NUMBA_CACHE_DIR', 'XDG_CACHE_HOME'


def run_restricted(code, allowed='', **environment):
    """Run Python where only one folder can be written to, or none."""
    home = {'HOME': '/proc/none', CACHE: '/proc/none', KEPT: ''}
    return python(RESTRICT + code, allowed, cwd=ROOT, env={**os.environ, **home, **environment})


@pytest.mark.skipif(sys.version_info < (3, 11), reason='PYTHONSAFEPATH is of Python 3.11')
def test_the_package_of_the_current_folder_is_not_compiled(tmp_path, monkeypatch):
    (tmp_path / 'rangeseg_ros').mkdir()
    (tmp_path / 'rangeseg_ros/__init__.py').write_text("open('imported', 'w')")
    monkeypatch.chdir(tmp_path)
    _compile(print, Config(), ('image',), ())
    assert not (tmp_path / 'imported').exists()


def test_where_nothing_can_be_kept_kernels_last_as_long_as_the_process(tmp_path):
    run = run_restricted(KERNEL, tmp_path)
    assert run.returncode == 0, run.stderr
    assert run.stderr.count('CacheWarning') == 1 and 'NUMBA_CACHE_DIR' in run.stderr
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize('start', ['rangeseg', 'segment_planes'])
def test_where_nothing_can_be_written_one_line_says_so(start):
    code = "tempfile.mkdtemp = temporary_file\nsys.argv[1:] = ['compile']\n"
    run = run_restricted(f'{code}from rangeseg_ros.start import {start}; {start}()')
    assert run.returncode == 2 and run.stderr.startswith(start) and run.stderr.count('\n') == 1
    assert 'NUMBA_CACHE_DIR' in run.stderr


@pytest.mark.parametrize(
    ('variable', 'mode'), [(KEPT, 0o777), (KEPT, 0o1777), (KEPT, 0o755), (CACHE, 0o777)]
)
def test_folders_named_by_the_user_come_first_but_where_others_can_write(tmp_path, variable, mode):
    """What is unpickled from there is executed."""
    named = tmp_path / 'named'
    within = named / 'rangeseg_ros' if variable == CACHE else named
    run = run_restricted(KERNEL, tmp_path, **{variable: os.fspath(named)})
    assert (run.returncode, run.stderr) == (0, '')
    indices = [*within.rglob('*.nbi')]
    assert indices
    for index in indices:
        index.write_bytes(CODE_IN_A_PICKLE)
    if mode == 0o755:  # as if somebody else had made it
        (state,) = named.glob('rangeseg_ros-*')
        state.chmod(0o777)
    named.chmod(mode)
    run = run_restricted(KERNEL, tmp_path, **{variable: os.fspath(named)})
    assert run.returncode == 0
    # Of a folder that is the user's in one that all may write to, as /tmp, nobody can change it.
    assert ('poison' in run.stdout) == (mode == 0o1777)
    assert ('is not used' in run.stderr) == (variable == KEPT and mode != 0o1777)


@pytest.mark.parametrize(
    ('mode', 'group', 'private'),
    [(0o770, 0, True), (0o770, 1, False), (0o755, 1, True), (0o702, 0, False), (0o1777, 0, False)],
)
def test_a_group_with_the_number_of_its_user_is_the_user(monkeypatch, mode, group, private):
    user = os.getuid()
    found = SimpleNamespace(st_uid=user, st_gid=user + group, st_mode=mode)
    monkeypatch.setattr(Path, 'lstat', lambda path: found)
    assert cache._private(Path('/somewhere/else')) == private


def test_linear_algebra_is_imported_for_kernels_that_call_it():
    code = 'from rangeseg_ros import Segmenter\nimport sys, numba, numpy\n' + KERNEL
    code += "\nassert 'scipy.linalg' not in sys.modules\n"
    assert not python(code + 'numba.njit(lambda a: a @ a)(numpy.eye(2))').stderr


def test_import_and_help_load_no_kernel():
    """So they need no place to write to."""
    code = "import rangeseg_ros\nassert 'numba' not in sys.modules\nsys.argv[1:] = ['--help']\n"
    run = run_restricted(code + 'from rangeseg_ros.start import rangeseg; rangeseg()')
    assert (run.returncode, run.stderr) == (0, '') and 'Commands' in run.stdout


def test_what_was_compiled_into_the_package_is_taken_along(tmp_path, monkeypatch):
    from numba.core.caching import _CacheLocator

    compiled = tmp_path / 'package/core/__pycache__/grid.f-1.py311.nbi'
    compiled.parent.mkdir(parents=True)
    compiled.write_bytes(b'index')
    monkeypatch.setattr(cache, 'PACKAGE', tmp_path / 'package')
    note, folder = compiled.with_name('compiled_from.json'), tmp_path / 'cache'
    folder.mkdir()
    for numba in ('0', *2 * [cache._state(cache.PACKAGE)['numba']]):
        note.write_text(f'{{"numba": "{numba}"}}')
        cache._copy_compiled(folder)
        assert any(folder.rglob('*.*')) == (numba != '0')
    subfolder = _CacheLocator.get_suitable_cache_subpath(compiled.parents[1] / 'grid.py')
    assert [p.relative_to(folder) for p in folder.rglob('*.*')] == [Path(subfolder, compiled.name)]


KERNEL_OF = 'from numba import njit\n@njit(cache=True)\ndef {}(): return {}\n'
MODULES = {
    '__init__': '',
    'core/__init__': '',
    'core/a': KERNEL_OF.format('f', 1),
    'core/b': 'from pack.core.a import f\n' + KERNEL_OF.format('g', 'f()'),
    'core/c': 'from pack.core import b\n' + KERNEL_OF.format('h', 'b.g()'),
    'core/d': KERNEL_OF.format('k', 3),
}
CALL = """
from pathlib import Path
from rangeseg_ros.kernel_cache import drop_outdated
drop_outdated(Path('pack'))
from pack.core.c import h
from pack.core.d import k
print(h(), k(), sum(h.stats.cache_hits.values()), sum(k.stats.cache_hits.values()))
"""


def test_kernels_are_compiled_anew_when_what_they_call_has_changed(tmp_path):
    """Or numba has, which by itself goes on with what was compiled into a kernel."""
    package = tmp_path / 'pack'
    (package / 'core' / '__pycache__').mkdir(parents=True)
    for name, text in MODULES.items():
        (package / f'{name}.py').write_text(text)

    def call():
        environment = {**os.environ, KEPT: '', 'PYTHONPATH': os.fspath(ROOT)}
        done = python(CALL, cwd=tmp_path, env=environment)
        return done.stdout.split() or done.stderr

    assert call() == ['1', '3', '0', '0'] and call() == ['1', '3', '1', '1']
    # Neither its time nor its size tells.
    changed = package / 'core' / 'a.py'
    before = changed.stat()
    changed.write_text(KERNEL_OF.format('f', 2))
    os.utime(changed, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert call() == ['2', '3', '0', '1']
    note = package / 'core/__pycache__/compiled_from.json'
    note.write_text(note.read_text().replace('"numba": "', '"numba": "0'))
    assert call() == ['2', '3', '0', '0']


@functools.cache
def found_by_a_process(*rehearsed):
    """Kernels that `rehearse(*rehearsed)` needs; discovery leaves its process interpreted."""
    with get_context('spawn').Pool(1) as pool:
        return pool.apply(discover, (functools.partial(rehearse, *rehearsed),))


@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_frames_need_nothing_more(method):
    """Of any size, as clouds, and with less of the work, which changes while frames come."""
    config = Config(method=method)
    prepare(config)
    budgets = [replace(config, work_budget=step) for step in BUDGETS[1:] if method == 'planes']
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
        returned = str(compiled[kernel.signature].signature.return_type)
        assert {*re.findall(r'(\w+)\(', returned)} <= {'array', 'Tuple', 'UniTuple'}, kernel.name


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
    run = python(FIRST_FRAME, env={**os.environ, KEPT: os.fspath(tmp_path)})
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
