"""Faults the node must survive, over real DDS: the next good frame is segmented."""

import os
import time
from array import array
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

from ros_bench import DEPTH, INFO, benches, corner_depth, values_of
from sensor_msgs.msg import PointCloud2

from rangeseg_ros import planes_from_message
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

pytestmark = pytest.mark.ros


node, bench = benches('labels', stall_timeout=3.0)


def assert_segments(bench):
    """The next good frame shows the two walls."""
    assert len(set(bench.segment().ravel()) - {0}) == 2


def test_camera_info_that_comes_late_or_never_or_of_another_frame(bench):
    begin, said = time.monotonic(), bench.log().count('no camera_info')
    before = len(bench.received['labels'])
    for _ in range(20):
        bench.depth.publish(bench.image())
        bench.spin(0.02)
    waiting = bench.image()
    bench.error(f'no camera_info on {INFO}', lambda: bench.depth.publish(waiting))
    assert 1 <= bench.log().count('no camera_info') <= said + 1 + (time.monotonic() - begin) / 5
    assert len(bench.received['labels']) == before
    bench.camera_info.publish(bench.info())
    assert bench.labels_of(waiting).any()
    assert_segments(bench)
    # That of another frame is used with a warning.
    info = bench.info()
    info.header.frame_id = 'elsewhere'
    # An image may come before it, and has the one before.
    bench.until(lambda: bench.segment(info=info).any() and "info in 'elsewhere'" in bench.log())


@pytest.mark.parametrize(
    'fields, words',
    [({'data': array('B', bytes(1000))}, '1000 bytes'), ({'height': 2**32 - 1}, '4294967295')],
)
def test_malformed_image(bench, fields, words):
    bench.error(words, lambda: bench.send(bench.image(**fields)))
    assert_segments(bench)


def test_a_topic_of_another_type_is_told(node):
    with node.listening('labels'), node.advertised(PointCloud2, DEPTH):
        node.error('(1 publishers of sensor_msgs/msg/PointCloud2)')


def test_camera_info_of_another_stamp_is_not_that_of_the_image(bench):
    """Zoom: the image comes 20 ms before its camera_info, which differs from the one before."""
    with bench.listening('planes'):
        for focal in (100.0, 200.0, 100.0):
            image = bench.image()
            bench.depth.publish(image)
            bench.spin(0.02)
            camera = replace(bench.camera, fx=focal, fy=focal)
            bench.camera_info.publish(bench.info(camera, header=image.header))
            found = planes_from_message(bench.answer('planes', image))['distance']
            # Walls z = 2 m - |x| of the bench's camera, seen with another focal length.
            expected = 2 / np.hypot(1, focal / bench.camera.fx)
            np.testing.assert_allclose(found, [expected] * 2, rtol=2e-3)
    status = bench.status(lambda status: values_of(status)['camera_info'])
    assert values_of(status)['camera_info'] == 'of the stamp of the image'


@pytest.mark.slow
def test_sizes_from_small_to_12_megapixels_whose_memory_comes_back(bench):
    def resident():
        pages = Path(f'/proc/{bench.process.pid}/statm').read_text().split()[1]
        return int(pages) * os.sysconf('SC_PAGE_SIZE') / 2**20

    def segment(width, height):
        camera = kinect_camera(width, height)
        labels = bench.segment(bench.image(corner_depth(camera)), bench.info(camera))
        assert labels.shape == (height, width) and labels.any()

    for size in ((32, 24), (320, 240)):
        segment(*size)
    before = resident()
    segment(4096, 3072)
    # Of 440 MB and more. What stays is the middleware's: its queues, of five images and of labels,
    # keep the size of the largest message, 25 MB each; fewer where they had held a large one.
    bench.repeat(lambda: segment(320, 240), lambda: resident() < before + 200)
