"""What the package says of itself in several places agrees."""

import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from unittest import mock
from xml.etree import ElementTree

import pytest
import yaml
from processes import python

from rangeseg_ros import __version__
from rangeseg_ros.extras import EXTRAS

ROOT = Path(__file__).parents[1]


@pytest.fixture
def setup_arguments(monkeypatch):
    """Arguments of setup() in setup.py."""
    monkeypatch.chdir(ROOT)
    setuptools = pytest.importorskip('setuptools')
    with mock.patch.object(setuptools, 'setup') as setup:
        runpy.run_path('setup.py')
    return setup.call_args.kwargs


def test_setup_package_xml_and_citation_agree(setup_arguments):
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text())
    assert setup_arguments['version'] == citation['version'] == __version__
    assert setup_arguments['license'] == citation['license'] and package.get('format') == '3'
    for tag in ('name', 'version', 'license'):
        assert package.findtext(tag) == setup_arguments[tag]
    assert package.findtext('export/build_type') == 'ament_python'
    declared = {element.text for element in package.iter('exec_depend')}
    keys = {key.removeprefix('python3-').removesuffix('-pip').lower() for key in declared}
    aliases = {'pyyaml': 'yaml', 'pillow': 'pil', 'opencv-python-headless': 'opencv'}
    for requirement in setup_arguments['install_requires']:
        name = re.match(r'[\w-]+', requirement)[0].lower()
        assert aliases.get(name, name) in keys
    # The messages that are used are named.
    text = '\n'.join(path.read_text() for path in (ROOT / 'rangeseg_ros').rglob('*.py'))
    used = set(re.findall(r'\b(\w+_(?:msgs|interfaces))(?:/msg/|\.(?:msg|srv)\b)', text))
    assert {'sensor_msgs', 'rcl_interfaces'} <= used <= declared


def test_every_library_that_may_be_missing_is_in_its_extra(setup_arguments):
    extras = setup_arguments['extras_require']
    packages = {'rclpy': 'ros-jazzy-rclpy'}
    for name, extra in EXTRAS.items():
        wanted = packages.get(name, name)
        assert any(re.match(rf'{wanted}\b', requirement) for requirement in extras[extra]), name
        assert not any(re.match(wanted, asked) for asked in setup_arguments['install_requires'])
    # Segmenting needs none of them.
    modules = 'cli.segment', 'cli.compile', 'notebook', 'core.sequence'
    code = ''.join(f'import rangeseg_ros.{name}\n' for name in modules)
    code += f'import sys; print(*set(sys.modules) & {set(EXTRAS)!r})'
    assert python(code).stdout == '\n'


def test_everything_is_installed_where_ros_looks(setup_arguments):
    folders = {path.parent for path in (ROOT / 'rangeseg_ros').rglob('*.py')}
    names = {'.'.join(folder.relative_to(ROOT).parts) for folder in folders}
    assert set(setup_arguments['packages']) == names
    data = setup_arguments['data_files']
    installed = {f'{folder}/{Path(file).name}' for folder, files in data for file in files}
    wanted = {'ament_index/resource_index/packages/rangeseg_ros', 'rangeseg_ros/package.xml'}
    for folder in ('launch', 'params', 'rviz'):
        found = (path for path in (ROOT / folder).iterdir() if path.is_file())
        wanted |= {f'rangeseg_ros/{folder}/{path.name}' for path in found}
    assert installed >= {f'share/{path}' for path in wanted}
    assert installed >= {f'lib/rangeseg_ros/{name}' for name in ('rangeseg', 'segment_planes')}


def test_launchers_match_the_console_scripts(setup_arguments):
    scripts = setup_arguments['entry_points']['console_scripts']
    scripts = dict(re.split(r' *= *', script) for script in scripts)
    assert set(scripts) == {path.name for path in (ROOT / 'scripts').iterdir()}
    for name, target in scripts.items():
        launcher = ROOT / 'scripts' / name
        assert launcher.stat().st_mode & 0o111
        assert 'from {} import {}\n'.format(*target.split(':')) in launcher.read_text()
        # As workers import it, which run nothing.
        runpy.run_path(str(launcher), run_name='__mp_main__')


def test_launchers_run_with_the_python_of_the_environment(tmp_path):
    launcher = shutil.copy(ROOT / 'scripts/rangeseg', tmp_path)
    python = tmp_path / 'python3'
    python.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} "$@"\n')
    python.chmod(0o755)
    environment = {'PATH': f'{tmp_path}:/bin:/usr/bin'}
    told = subprocess.check_output([launcher, '--help'], text=True, cwd=tmp_path, env=environment)
    assert told.startswith('Usage: rangeseg')


def test_the_digest_follows_every_source_of_the_package(tmp_path):
    package, left_out = tmp_path / 'rangeseg_ros', shutil.ignore_patterns('*.nb*', '*.pyc')
    shutil.copytree(ROOT / 'rangeseg_ros', package, ignore=left_out)
    code = 'from rangeseg_ros.digest import code_digest; print(code_digest().hex())'
    seen = {python(code, cwd=tmp_path).stdout}
    for name in ('core/config.py', 'io/tables.py', 'report/templates/replay.html'):
        with (package / name).open('a') as file:
            file.write('\n')
        seen.add(python(code, cwd=tmp_path).stdout)
    assert len(seen) == 4


def test_colcon_builds_without_numba_and_says_that_nothing_is_compiled(tmp_path):
    pytest.importorskip('setuptools')
    (tmp_path / 'numba.py').write_text("raise ImportError('no numba here')\n")
    commands = ['egg_info', '--egg-base', tmp_path, 'build', '--build-base', tmp_path / 'build']
    commands += ['install', '--prefix', tmp_path / 'install', '--record', tmp_path / 'installed']
    commands += ['--single-version-externally-managed']
    environment = {**os.environ, 'PYTHONPATH': os.fspath(tmp_path)}
    environment.pop('RANGESEG_COMPILE', None)
    code = "import runpy; runpy.run_path('setup.py', run_name='__main__')"
    done = python(code, *commands, cwd=ROOT, env=environment)
    assert done.returncode == 0, done.stderr
    place = (tmp_path / 'install').relative_to('/').as_posix()
    assert place in (tmp_path / 'installed').read_text()
    told = 'kernels are left for the first start to compile: ImportError: no numba here'
    assert [line for line in done.stderr.splitlines() if 'kernels' in line] == [told]
