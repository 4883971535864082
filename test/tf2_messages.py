"""tf2_msgs for tests where no ROS is installed: built once from its one message, and kept.

Every ROS installation has it, but there is no wheel. The wheels of the generators are enough to
make it with CMake and gcc in half a minute.
"""

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

AMENT = 'package cmake cmake-ros cmake-include-directories cmake-gmock cmake-gtest cmake-pytest'
GENERATORS = ['rosidl-default-generators', 'rosidl-core-generators', 'python-cmake-module']
GENERATORS += [f'ament-{name}' for name in AMENT.split()]
GENERATORS = [f'ros-jazzy-{name}' for name in GENERATORS]
TOOLS = ['catkin_pkg', 'lark', 'empy==3.3.4']
CMAKE = """
cmake_minimum_required(VERSION 3.8)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(tf2_msgs "msg/TFMessage.msg" DEPENDENCIES geometry_msgs)
ament_package()
"""
PACKAGE = """<?xml version="1.0"?>
<package format="3">
  <name>tf2_msgs</name><version>0.36.0</version><description>tf2</description>
  <maintainer email="tests@example.org">tests</maintainer><license>BSD</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""


def provide(monkeypatch):
    """Make tf2_msgs importable here and in processes started from here; why not, if not."""
    if find_spec('tf2_msgs'):
        return ''
    version = f'python{sys.version_info.major}.{sys.version_info.minor}'
    cache = Path(os.environ.get('XDG_CACHE_HOME', Path.home() / '.cache'))
    folder = cache / 'rangeseg_ros_tests' / f'tf2_msgs_{version}'
    if not folder.exists():
        problem = _build(folder, version)
        if problem:
            return f'tf2_msgs is not installed and cannot be built: {problem}'
    packages, libraries = folder / 'lib' / version / 'site-packages', folder / 'lib'
    variables = 'PYTHONPATH', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH'
    for variable, path in zip(variables, (packages, libraries, folder), strict=True):
        monkeypatch.setenv(variable, f'{path}:{os.environ.get(variable, "")}'.rstrip(':'))
    monkeypatch.syspath_prepend(str(packages))
    # Loaded by name later, which finds what is loaded already.
    built = sorted(libraries.glob('*.so'))
    for library in built * len(built):  # again, as some need others
        with suppress(OSError):
            ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    return ''


def _build(folder, version):
    """Build into a folder; what keeps it from being built."""
    for tool in ('cmake', 'make', 'gcc', 'g++'):
        if not shutil.which(tool):
            return f'no {tool}'
    spec = find_spec('geometry_msgs')
    if spec is None:
        return 'no geometry_msgs'
    messages = Path(spec.origin).parents[1]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        work, tools = Path(scratch), Path(scratch, 'tools')

        def run(*command, **environment):
            clean = {k: v for k, v in os.environ.items() if k != 'PYTHONPATH'} | environment
            return subprocess.run(command, capture_output=True, text=True, env=clean)

        run(sys.executable, '-m', 'venv', tools)
        run(tools / 'bin/pip', 'install', '--quiet', *GENERATORS, *TOOLS)
        prefixes = f'{tools}:{messages.parents[2]}'
        there = {
            'PYTHONPATH': f'{tools}/lib/{version}/site-packages:{messages}',
            'AMENT_PREFIX_PATH': prefixes,
            'CMAKE_PREFIX_PATH': prefixes,
        }
        (work / 'msg').mkdir()
        (work / 'msg/TFMessage.msg').write_text('geometry_msgs/TransformStamped[] transforms\n')
        (work / 'CMakeLists.txt').write_text(CMAKE)
        (work / 'package.xml').write_text(PACKAGE)
        options = [f'-D{name}_EXECUTABLE={tools}/bin/python' for name in ('Python3', 'PYTHON')]
        options += [f'-DCMAKE_INSTALL_PREFIX={work}/tf2_msgs', '-DBUILD_TESTING=OFF']
        # It complains at the end of an include directory of Python that no one needs.
        run('cmake', '-S', scratch, '-B', f'{work}/build', *options, **there)
        done = run('make', '-C', f'{work}/build', '-j2', '-k', 'install', **there)
        if not (work / f'tf2_msgs/lib/{version}/site-packages/tf2_msgs').exists():
            return (done.stderr or done.stdout).strip().splitlines()[-1:]
        (work / 'tf2_msgs').rename(folder)
    return ''
