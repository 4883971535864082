"""The node at its start, and as it ends: arguments, kernels that are not compiled, Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import fields

import pytest

pytest.importorskip('rclpy')

from processes import python
from ros_bench import DEPTH, NODE, Bench, ended, started, values_of

from rangeseg_ros.ros.parameters import NodeConfig
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

pytestmark = pytest.mark.ros

QOS = f'qos_overrides.{DEPTH}.subscription'


def test_where_there_is_no_rclpy_it_says_so():
    code = "import sys; sys.modules['rclpy'] = None\n"
    run = python(code + 'from rangeseg_ros.start import segment_planes; segment_planes()')
    assert run.returncode == 2
    assert run.stderr.startswith('segment_planes: no rclpy') and run.stderr.count('\n') == 1


def test_a_first_start_says_that_it_compiles(tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', os.fspath(tmp_path))
    with started(stall_timeout=0.5, namespace='first') as bench:
        bench.error(' s: compiling kernels', bench.send)
        assert 'compiling kernels' in bench.log()
        assert 'will subscribe to {} and {}'.format(*bench.topics) in bench.log()


@pytest.mark.parametrize('presses', [1, 2])
def test_interrupted_during_a_computation(presses):
    slow = {'method': 'normals', 'exact': True, 'camera': kinect_camera(320, 240)}
    with started(namespace='busy', **slow) as bench:
        bench.send()
        bench.status(lambda status: 'segmenting' in values_of(status)['doing'])
        assert not bench.received['labels'], 'the computation is over'
        for _ in range(presses):
            bench.interrupt()
            time.sleep(0.05)
        assert bench.process.wait(timeout=300) == 0


BAD = {
    "is 'min_pixels' meant?": ('--ros-args', '-p', 'min_pixel:=3'),
    'smoothness': ('--ros-args', '-p', 'smoothness:=true'),
    "'DOUBLE', such as 3.0": ('--ros-args', '-p', 'smoothness:=3'),
    'parameter method must be one of': ('--ros-args', '-p', 'method:=magic'),
    'parameter mask: /none.png': ('--ros-args', '-p', 'mask:=/none.png'),
    'reliable, best_effort': ('--ros-args', '-p', f'{QOS}.reliability:=best'),
    'number of messages': ('--ros-args', '-p', f'{QOS}.depth:=-1'),
    f"is '{QOS}.reliability' meant?": ('--ros-args', '-p', f'{QOS}.relaibility:=reliable'),
    '/nonexistent': ('--ros-args', '--params-file', '/nonexistent'),
    'bad/name': ('--ros-args', '-r', '__node:=bad/name'),
    '--method': ('--method', 'normals'),
}
EACH_IN_A_FORK = """
import os, sys, warnings
warnings.simplefilter('ignore')  # of forks beside threads
from rangeseg_ros.ros.node import main
for arguments in eval(sys.argv[1]):
    if os.fork() == 0:
        sys.argv[1:] = arguments
        main()
    print(os.waitstatus_to_exitcode(os.wait()[1]), flush=True)
"""


def test_bad_arguments_end_with_one_line(tmp_path):
    bad, quality = dict(BAD), '{/ns/depth/image_rect: {subscription: {relaibility: reliable}}}'
    for words, own in (
        ("is 'smoothness' meant?", 'smothness: 3.0'),
        (".reliability' meant?", f'qos_overrides: {quality}'),
    ):
        file = tmp_path / f'{len(bad)}.yaml'
        file.write_text(f'ns:\n  segment_planes:\n    ros__parameters: {{{own}}}\n')
        bad[words] = '--ros-args', '-r', '__ns:=/ns', '--params-file', os.fspath(file)
    run = python(EACH_IN_A_FORK, repr([*bad.values()]))
    assert run.stdout.split() == ['2'] * len(bad), run.stderr
    for line, words in zip(run.stderr.splitlines(), bad, strict=True):
        assert line.startswith('segment_planes: ') and words in line


def test_it_starts_with_a_shared_file_and_no_place_for_log_files_and_warns_of_both(tmp_path):
    shared = tmp_path / 'shared.yaml'
    shared.write_text(
        '/**:\n  ros__parameters:\n    odom_frame: odom\n    min_pixels: 7\n'
        '    qos_overrides: {/scan: {subscription: {depth: -1}}}\n'
        '    start_type_description_service: false\n'
    )
    command = ['/usr/bin/env', 'ROS_LOG_DIR=/proc/none', *NODE]
    with Bench('--params-file', os.fspath(shared), command=command, namespace='shared') as bench:
        said = 'will subscribe', '/proc/none cannot be written to'
        bench.until(lambda: all(part in bench.log() for part in said))
        assert bench.log().count(said[1]) == 1
        assert "unknown parameter 'odom_frame'; is 'odometry_frame' meant?" in bench.log()
        assert "'qos_overrides./scan.subscription.depth' is of another topic" in bench.log()
        assert bench.log().count('ignored') == 2


def test_help_names_every_parameter():
    run = python(NODE[-1], '--help')
    assert run.returncode == 0 and not run.stderr
    assert all(f'  {field.name} (default' in run.stdout for field in fields(NodeConfig))


@pytest.mark.parametrize(
    'command, delay',
    [
        *(('rangeseg', 0.0), ('rangeseg', 1.2), ('segment_planes', 0.0), ('segment_planes', 1.2)),
        ('segment_planes', 'as it begins to spin'),
    ],
)
def test_interrupted_at_the_start(command, delay):
    code = f'from rangeseg_ros.start import {command}; print("begun", flush=True); {command}()'
    arguments = ['bench', '--rounds', '99'] if command == 'rangeseg' else []
    command, output = [sys.executable, '-c', code, *arguments], subprocess.PIPE
    process = subprocess.Popen(command, stdout=output, stderr=output, text=True)
    with ended(process):
        # Before that Python itself is not ready.
        assert process.stdout.readline() == 'begun\n'
        if isinstance(delay, float):
            time.sleep(delay)
        else:
            assert 'will subscribe' in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=300)
    assert 'Traceback' not in errors and process.returncode in (0, 130), errors
