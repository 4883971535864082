"""`rangeseg play` and the node: what is published of a recording, and when."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from processes import RANGESEG
from recordings import Recording, depth_images

pytest.importorskip('rclpy')

from ros_bench import DEPTH, INFO, Bench, ended, values_of
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image

from rangeseg_ros.cli import play
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

# Of parsers of messages, as they are imported.
pytestmark = [pytest.mark.ros, pytest.mark.filterwarnings('ignore::DeprecationWarning')]

PROFILE = Path(__file__).parents[1] / 'params' / 'fastdds_large_images.xml'


def test_rate_loop_and_clock(tmp_path):
    """Ten images a second apart, twenty times as fast, again and again; /clock between them."""
    with DepthBagWriter(tmp_path / 'bag', kinect_camera(16, 12)) as bag:
        for second in range(1, 11):
            bag.write(np.ones((12, 16), np.uint16), second * 10**9)
    images, infos, times = [], [], []
    with Bench() as bench:
        bench.node.create_subscription(Image, DEPTH, images.append, 1000)
        bench.node.create_subscription(CameraInfo, INFO, infos.append, 1000)
        bench.node.create_subscription(Clock, '/clock', times.append, 1000)
        options = ('--rate', '20', '--loop', '--clock')
        player = subprocess.Popen([*RANGESEG, 'play', tmp_path / 'bag', *options])
        with ended(player):
            # A machine that is busy loses some of the clock.
            between = (time for time in times if time.clock.nanosec > 0)
            bench.until(lambda: len(images) >= 25 and next(between, None))
    stamps = [message.header.stamp.sec for message in images[:25]]
    assert stamps == [(stamps[0] - 1 + index) % 10 + 1 for index in range(25)]
    assert len(infos) > 1 and all(1 <= time.clock.sec <= 10 for time in times)


def test_no_large_image_is_lost_with_the_profile(tmp_path, monkeypatch):
    publisher = """
import array, time, rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node('camera')
qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
images = node.create_publisher(Image, '/depth/image_rect', qos)
while not images.get_subscription_count():
    time.sleep(0.05)
time.sleep(0.5)
image = Image(height=480, width=640, encoding='16UC1', step=1280)
image.data = array.array('B', bytes(1280 * 480))
# Fewer than the shared memory of the profile holds, as nobody may read for a while.
for _ in range(20):
    images.publish(image)
    time.sleep(1 / 30)
time.sleep(0.5)
"""
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', os.fspath(PROFILE))
    with Bench(stall_timeout=3600.0) as bench, bench.listening('labels'):
        camera = subprocess.Popen([sys.executable, '-c', publisher])
        monkeypatch.delenv('FASTRTPS_DEFAULT_PROFILES_FILE')
        bench.until(lambda: camera.poll() is not None)
        # Images without camera_info are received and go no further.
        status = bench.status(lambda status: 'no camera_info' in status.message)
    assert camera.returncode == 0
    assert values_of(status)['messages lost by the middleware'] == '0'


def test_topics_that_ros_refuses_are_left_out_and_messages_are_in_time(tmp_path, run, monkeypatch):
    slept, recording = [], Recording()
    time = SimpleNamespace(monotonic=lambda: sum(slept), sleep=slept.append)
    monkeypatch.setattr(play, 'time', time)
    recording.add_camera(10**9, topic='/a b')
    for second in (3, 9):
        recording.add_camera(second * 10**9, topic='/fine')
    recording.write(tmp_path / 'bag')
    code, output, _ = run('play', tmp_path / 'bag', '--rate', 4)
    assert code == 0 and "'/a b' is no topic of ROS 2, left out" in output
    assert sum(slept) == pytest.approx(1 + 6 / 4)  # a second for whoever subscribes
    assert run('play', tmp_path / 'bag', '--rate', 'nan')[0] == 2


def test_a_recording_that_is_damaged_is_said_to_be(tmp_path, run):
    with DepthBagWriter(tmp_path / 'bag', kinect_camera(640, 480)) as bag:
        for index, depth in enumerate(depth_images(10, 480, 640)):
            bag.write(depth, 10**9 + index * 10**7)
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    whole, half = file.read_bytes(), file.stat().st_size // 2
    for damaged, problem in (
        (whole[:half], 'bag: without its end'),
        (whole[:half] + bytes(2**21) + whole[half + 2**21 :], 'bag: damaged chunk'),
    ):
        file.write_bytes(damaged)
        code, _, error = run('play', tmp_path / 'bag')
        assert code == 2 and error.count('\n') == 1 and problem in error
