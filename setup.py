import json
import os
import re
import subprocess
import sys
import sysconfig
from contextlib import suppress
from glob import glob
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup
from setuptools.command.install import install

package_name = 'rangeseg_ros'
share = f'share/{package_name}'
# The real folder: `colcon build --symlink-install` runs a link to this file elsewhere.
sources = Path(__file__).resolve().parent
# Who maintains it, and where it is: `make release-names` writes them there.
package = ElementTree.parse(sources / 'package.xml').getroot()
maintainer = package.find('maintainer')
(version,) = re.findall(
    r"^__version__ = '(.+)'$", Path(package_name, '__init__.py').read_text('utf-8'), re.MULTILINE
)


# Processor of a wheel that carries the kernels (`make wheel`), as NUMBA_CPU_NAME; else empty.
cpu = os.environ.get('RANGESEG_WHEEL', '')


def compile_kernels(folder):
    """Have the package in `folder` compile its kernels, so that its first start need not.

    They are kept in the package. An installation without them is one all the same.
    """
    if os.environ.get('RANGESEG_COMPILE') == '0':
        return
    if cpu:
        target = Path(folder, package_name, 'core', '__pycache__', 'compiled_for.json')
        target.parent.mkdir(exist_ok=True)
        target.write_text(json.dumps({'cpu': cpu, 'numba': metadata.version('numba')}))
    start = 'from rangeseg_ros.start import rangeseg; rangeseg()'
    # There, as Python looks for packages first where it is started: not beside the sources.
    made = subprocess.run(
        [sys.executable, '-c', start, 'compile'], cwd=folder, stderr=subprocess.PIPE, text=True
    )
    if made.returncode and cpu:
        sys.exit(made.stderr)
    if made.returncode:
        *_, why = made.stderr.strip().splitlines() or [f'exit code {made.returncode}']
        print(f'kernels are left for the first start to compile: {why}', file=sys.stderr)


# What `colcon build` runs; pip makes a wheel, for whatever machine.
class Install(install):
    def run(self):
        super().run()
        # Wheels and Debian packages are put together in a folder of their own.
        if not self.root:
            compile_kernels(self.install_lib)


commands = {'install': Install}
if cpu:
    from setuptools.command.bdist_wheel import bdist_wheel
    from setuptools.command.build_py import build_py

    class BuildWithKernels(build_py):
        def run(self):
            super().run()
            compile_kernels(self.build_lib)

    class PlatformWheel(bdist_wheel):
        def get_tag(self):
            """Of kernels for one version of Python, whose bytecode numba compares."""
            python = f'cp{sys.version_info.major}{sys.version_info.minor}'
            return python, 'none', sysconfig.get_platform().replace('-', '_')

    commands |= {'build_py': BuildWithKernels, 'bdist_wheel': PlatformWheel}
# Deprecated: a setuptools without it, with which colcon makes no links, must not end every build.
with suppress(ImportError):
    from setuptools.command.develop import develop

    # What `colcon build --symlink-install` runs.
    class Develop(develop):
        def run(self):
            super().run()
            if not getattr(self, 'uninstall', False):
                compile_kernels(os.getcwd())

    commands['develop'] = Develop


# What only some commands and functions need; rangeseg_ros/extras.py names them where missing.
bags = ['rosbags>=0.11.9,<0.12', 'jinja2>=3.0', 'matplotlib>=3.6']

setup(
    name=package_name,
    version=version,
    description='Planar segmentation of range images by multi-label graph cuts, for ROS 2',
    long_description=(sources / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    author=maintainer.text,
    author_email=maintainer.get('email'),
    maintainer=maintainer.text,
    maintainer_email=maintainer.get('email'),
    url=package.findtext('url', ''),
    license='GPL-3.0-or-later',
    keywords=['ROS', 'depth image', 'range image', 'plane segmentation', 'graph cuts'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Environment :: Console',
        'Intended Audience :: Developers',
        'Intended Audience :: Science/Research',
        'License :: OSI Approved :: GNU General Public License v3 or later (GPLv3+)',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.10',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering :: Image Recognition',
        'Typing :: Typed',
    ],
    packages=find_packages(include=[package_name, f'{package_name}.*']),
    package_data={package_name: ['py.typed', 'report/templates/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
        (share, ['package.xml']),
        (f'{share}/launch', glob('launch/*.py')),
        (f'{share}/params', glob('params/*')),
        (f'{share}/rviz', glob('rviz/*')),
        # `ros2 run` looks here. colcon puts the console scripts here as well, by setup.cfg; pip
        # does not.
        (f'lib/{package_name}', glob('scripts/*')),
    ],
    python_requires='>=3.10',
    install_requires=[
        'click>=8.0',
        'mapbox-earcut>=1.0,<3',
        # kernel_cache.py uses what it keeps to itself.
        f'numba=={metadata.version("numba")}' if cpu else 'numba>=0.61.2,<0.69',
        'numpy>=1.26',
        'opencv-python-headless>=4.6',
        'pillow>=9.4',
        'PyYAML>=5.4',
        'scipy>=1.11',
        'shapely>=2.0',
        'tqdm>=4.60',
    ],
    extras_require={
        # PyMaxflow is what the minimum cuts are compared with, mcap what the bags are read by.
        'test': [
            *bags,
            'OpenEXR>=3.3',
            'PyMaxflow>=1.3',
            'ezdxf>=1.1',
            'hypothesis>=6.90',
            'mcap>=1.2.1',
            'pandas>=2.0',
            'pypcd4>=1.2',
            'pytest>=7.4',
            'pytest-cov>=7.0',
            'pytest-timeout>=2.2',
            'pytest-xdist>=3.3',
            'trimesh>=4.0',
        ],
        'bags': bags,
        # The name that it had with the reports of recordings.
        'report': bags,
        'notebook': ['matplotlib>=3.6', 'pandas>=2.0', 'trimesh>=4.0'],
        'open3d': ['open3d>=0.18'],
        'exr': ['OpenEXR>=3.3'],
        'pcd': ['pypcd4>=1.2'],
        'dask': ['distributed>=2023.1'],
        'plan': [*bags, 'ezdxf>=1.1', 'trimesh>=4.0'],
        'docs': ['mkdocs-material>=9.5', 'mkdocstrings[python]>=0.26'],
        'lint': ['import-linter>=2.1', 'mypy>=1.8', 'ruff>=0.4', 'types-PyYAML'],
        # The node where no ROS 2 is installed: rclpy over Fast DDS as wheels. A sourced ROS 2 has
        # all of these, so do not install this extra beside one.
        'jazzy': [
            'ros-jazzy-rclpy',
            'ros-jazzy-builtin-interfaces',
            'ros-jazzy-lifecycle-msgs',
            'ros-jazzy-rmw-fastrtps-cpp',
            'ros-jazzy-sensor-msgs',
            'ros-jazzy-geometry-msgs',
            'ros-jazzy-std-msgs',
            'ros-jazzy-nav-msgs',
            'ros-jazzy-shape-msgs',
            'ros-jazzy-visualization-msgs',
            'ros-jazzy-diagnostic-msgs',
        ],
    },
    zip_safe=True,
    cmdclass=commands,
    entry_points={
        'console_scripts': [
            'rangeseg = rangeseg_ros.start:rangeseg',
            'segment_planes = rangeseg_ros.start:segment_planes',
        ]
    },
)
