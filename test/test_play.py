"""`rangeseg play` and the node: what is published of a recording, and when."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recordings import Recording

pytest.importorskip('rclpy')

from ros_bench import DEPTH, INFO, Bench, corner_depth, values_of

from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

pytestmark = pytest.mark.ros

PROFILE = Path(__file__).parents[1] / 'params' / 'fastdds_large_images.xml'
RANGESEG = [sys.executable, '-c', 'from rangeseg_ros.cli.main import main; main()']


def record(path, camera, count, period):
    """Write a bag of two walls that come nearer from image to image."""
    with DepthBagWriter(path, camera) as bag:
        for index in range(count):
            depth = corner_depth(camera) - np.uint16(10 * index)
            bag.write(depth, 10**9 + round(index * period * 1e9))


def test_rate_and_loop(tmp_path):
    """Ten images a second apart, twenty times as fast, again and again."""
    bag = tmp_path / 'bag'
    record(bag, kinect_camera(16, 12), 10, 1.0)
    received = []
    with Bench() as bench:
        from sensor_msgs.msg import CameraInfo, Image

        kept = bench.node.create_subscription(Image, DEPTH, received.append, 1000)
        infos = []
        bench.node.create_subscription(CameraInfo, INFO, infos.append, 1000)
        player = subprocess.Popen([*RANGESEG, 'play', bag, '--rate', '20', '--loop'])
        try:
            bench.until(lambda: len(received) >= 25)
        finally:
            player.terminate()
            player.wait()
        bench.node.destroy_subscription(kept)
    stamps = [message.header.stamp.sec for message in received[:25]]
    first = stamps[0]
    assert stamps == [(first - 1 + index) % 10 + 1 for index in range(25)]
    assert len(infos) > 1


def test_the_clock_of_the_recording(tmp_path):
    """Two images a second apart, twice as fast, over and over: /clock runs between them."""
    from rosgraph_msgs.msg import Clock

    record(tmp_path / 'bag', kinect_camera(16, 12), 2, 1.0)
    times = []
    with Bench() as bench:
        bench.node.create_subscription(
            Clock, '/clock', lambda m: times.append(m.clock.sec + 1e-9 * m.clock.nanosec), 1000
        )
        options = ('--rate', '2', '--clock', '--loop')
        player = subprocess.Popen([*RANGESEG, 'play', tmp_path / 'bag', *options])
        try:
            # A machine that is busy loses some of them.
            bench.until(lambda: times.count(2.0) > 1 and any(1 < now < 2 for now in times))
        finally:
            player.terminate()
            player.wait()
    assert min(times) >= 1.0 and max(times) == 2.0


def test_no_large_image_is_lost_with_the_profile(tmp_path, monkeypatch):
    """The counterpart of the test of the node in which, without the profile, images are lost."""
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
    camera = subprocess.Popen([sys.executable, '-c', publisher])
    with Bench('-p', 'stall_timeout:=3600.0') as bench, bench.listening('labels'):
        monkeypatch.delenv('FASTRTPS_DEFAULT_PROFILES_FILE')
        bench.until(lambda: camera.poll() is not None)
        # Images without camera_info are received and go no further.
        status = bench.status(lambda status: 'no camera_info' in status.message)
    assert camera.returncode == 0
    assert values_of(status)['messages lost by the middleware'] == '0'


def test_topics_that_ros_refuses_are_left_out(tmp_path, run):
    pytest.importorskip('rclpy')
    recording = Recording()
    recording.add_camera(1, topic='/a b')
    recording.add_camera(2, topic='/fine')
    recording.write(tmp_path / 'bag')
    code, output, _ = run('play', tmp_path / 'bag')
    assert code == 0 and "'/a b' is no topic of ROS 2, left out" in output
    assert run('play', tmp_path / 'bag', '--rate', 'nan')[0] == 2


def test_a_recording_without_its_end_is_said_to_have_none(tmp_path, run):
    record(tmp_path / 'bag', kinect_camera(640, 480), 10, 0.01)
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    os.truncate(file, file.stat().st_size * 6 // 10)
    code, _, error = run('play', tmp_path / 'bag')
    assert code == 2 and error.count('\n') == 1 and 'bag: without its end' in error
