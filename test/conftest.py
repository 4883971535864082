"""Settings of every test."""

import json
import os
import signal
import sys

import numpy as np
import pytest
import yaml
from hypothesis import settings

# Systems of a few equations: threads of the linear algebra only wait for each other, for minutes
# on a busy machine. To be set before NumPy is imported, here and in the processes tests start.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from rangeseg_ros import Camera
from rangeseg_ros.cli.main import main
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image

# A shell that starts tests in the background has them ignore interrupts, nohup hang-ups, and with
# them the processes that they start and signal. Those forget a handler, but not what is ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda number, stack: None)

# The same examples on every run, and no timed tests: machines are busy.
settings.register_profile('rangeseg', deadline=None, derandomize=True)
# New examples in every run, those that fail printed: pytest --hypothesis-profile nightly.
settings.register_profile('nightly', deadline=None, max_examples=500, print_blob=True)
settings.load_profile('rangeseg')


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command: the exit code, standard output and error."""

    def run_command(*arguments):
        monkeypatch.setattr(sys, 'argv', ['rangeseg', *map(str, arguments)])
        with pytest.raises(SystemExit) as done:
            main()
        output, error = capsys.readouterr()
        # Which test is the first to need kernels is told by their order.
        compiles = 'rangeseg_ros: compiling kernels, once after the installation\n'
        return done.value.code or 0, output, error.replace(compiles, '')

    return run_command


@pytest.fixture
def refused(run):
    """Run a command that ends with code 2, one line on standard error and none on the other."""

    def run_command(*arguments):
        code, output, error = run(*arguments)
        assert (code, output, error.count('\n')) == (2, '', 1)
        assert error.startswith('rangeseg: ')
        return error

    return run_command


@pytest.fixture(scope='session')
def seen():
    """Frame of a simulated room, as a Kinect sees it."""
    # Not all tests wait for the simulation to be imported.
    from rangeseg_ros.simulation.render import simulate
    from rangeseg_ros.simulation.scenes import kinect_room
    from rangeseg_ros.simulation.sensors.catalogue import SENSORS

    return simulate(kinect_room(3), SENSORS['kinect'](1), seed=3)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Working folder with camera.yaml and two depth images, one of them of a wall."""
    monkeypatch.chdir(tmp_path)
    write_camera(tmp_path / 'camera.yaml', Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
    write_image(tmp_path / 'depth' / '2.png', np.full((48, 64), 1500, np.uint16))
    write_image(tmp_path / 'depth' / '10.png', np.zeros((48, 64), np.uint16))
    return tmp_path


@pytest.fixture
def figures_of(run, tmp_path):
    """Run a command with --json: exit code, figures (or None), standard output and error."""

    def run_command(*arguments):
        path = tmp_path / 'figures.json'
        code, output, error = run(*arguments, '--json', path)
        return code, json.loads(path.read_text()) if path.exists() else None, output, error

    return run_command


@pytest.fixture
def segment_image(run, tmp_path):
    """Segment a depth image by the command: exit code, standard output and error."""

    def segment(depth, camera, **parameters):
        write_camera(tmp_path / 'camera.yaml', camera)
        write_image(tmp_path / 'depth.png', depth)
        (tmp_path / 'params.yaml').write_text(yaml.safe_dump(parameters))
        files = {name: tmp_path / f'{name}.yaml' for name in ('camera', 'params')}
        options = '--camera', files['camera'], '--params', files['params']
        return run('segment', tmp_path / 'depth.png', *options, '--output', tmp_path / 'out')

    return segment
