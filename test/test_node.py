"""The node over real DDS: what it publishes, when, and by which quality of service."""

import re
import struct
import subprocess
import sys
from array import array
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import ReliabilityPolicy
from ros_bench import BEST_EFFORT, DEPTH, Bench, benches, corner_depth, ended, values_of
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.messages.clouds import points_message
from rangeseg_ros.messages.make import make_rclpy

pytestmark = pytest.mark.ros

EXAMPLE = Path(__file__).parents[1] / 'examples' / 'print_planes.py'


node, bench = benches('labels')


@pytest.fixture(scope='module')
def expected(node):
    """Labels of the core for the image that the bench publishes by default."""
    image = RangeImage.from_depth(corner_depth(node.camera), node.camera)
    labels = Segmenter(Config()).segment(image).labels
    # Two walls: were the core to find none, the tests below would say little.
    assert len(set(labels.ravel()) - {0}) == 2
    return labels


def test_reliability_follows_the_publishers(node, expected):
    with node.listening('labels'):
        with node.camera_on(qos=BEST_EFFORT):
            np.testing.assert_array_equal(node.stream(), expected)
        with node.camera_on():
            np.testing.assert_array_equal(node.segment(), expected)
            with node.advertised(Image, DEPTH, BEST_EFFORT):
                node.settled(DEPTH, ReliabilityPolicy.BEST_EFFORT)
                np.testing.assert_array_equal(node.stream(), expected)
            node.settled(DEPTH, ReliabilityPolicy.RELIABLE)
            np.testing.assert_array_equal(node.segment(), expected)


@pytest.mark.parametrize('source', ['compressed_depth', 'points'])
def test_other_inputs(node, expected, source):
    depth = corner_depth(node.camera)
    if source == 'points':
        topic, kind, least = '/depth/points', PointCloud2, 0.99  # rounding decides at the crease
        points = RangeImage.from_depth(depth, node.camera).points.reshape(-1, 3)
        points = np.pad(points.astype(np.float32), ((0, 0), (0, 1)))
        message = points_message(make_rclpy, node.header(), points)
        message.height, message.width = depth.shape
        message.row_step = message.width * message.point_step
    else:
        topic, kind, least = f'{DEPTH}/compressedDepth', CompressedImage, 1.0
        message = CompressedImage(header=node.header(), format='16UC1; compressedDepth png')
        png = cv2.imencode('.png', depth)[1].tobytes()
        message.data = array('B', struct.pack('<iff', 0, 0.0, 0.0) + png)
    with node.listening('labels'):
        node.set_parameters(input=source)
        with node.camera_on(topic, kind=kind):
            assert np.mean(node.segment(message) == expected) >= least
        node.set_parameters(input='image')


def test_the_example_reads_the_planes(bench, tmp_path):
    printed = tmp_path / 'printed'
    with printed.open('w') as errors:
        run = subprocess.Popen([sys.executable, EXAMPLE], stderr=errors)
    with ended(run):
        # The walls are a square root of 2 away.
        bench.until(lambda: bench.stream().any() and 'distance 1.41' in printed.read_text())
        assert '2 planes in camera_depth_optical_frame' in printed.read_text()
        run.terminate()
        bench.until(lambda: run.poll() is not None)
    assert run.returncode == 0 and 'Traceback' not in printed.read_text(), printed.read_text()


def test_diagnostics_tell_where_the_time_goes(bench):
    # On a machine that is so busy that the image came seconds late, there is no transport.
    status = bench.status(
        lambda s: s.message.startswith('2 planes') and 'transport (ms)' in values_of(s), bench.send
    )
    assert status.level == DiagnosticStatus.OK
    assert status.name == 'segment_planes: segmentation' and status.hardware_id == DEPTH
    values = values_of(status)
    parts = ('transport', 'waiting', 'conversion', 'compute', 'publication')
    times = [float(values[f'{part} (ms)']) for part in parts]
    assert min(times) >= 0 and sum(times) == pytest.approx(float(values['latency (ms)']), abs=0.05)
    stages = [float(values[key]) for key in values if key.startswith('compute: ')]
    assert stages and sum(stages) <= times[3] + 0.05
    assert re.match(r'noise 0\.\d+ 1/m', values['sensor'])
    counts = [int(values[f'frames {what}']) for what in ('received', 'published')]
    assert counts[0] >= counts[1] > 0


def test_latest_frame_wins_and_parameters_answer_meanwhile(bench, expected):
    """Of frames that come during long computations only the newest is segmented."""

    def dropped(status):
        return int(values_of(status)['frames dropped for newer ones'])

    # A report from now on: the tests before may have dropped frames.
    bench.spin(1.5)
    before = dropped(bench.status(lambda status: True))
    # For two seconds, so that a report, which comes every second, says it.
    bench.set_parameters(method='normals', exact=True, direction_count=1249)
    bench.in_use()
    images = [bench.image() for _ in range(5)]
    bench.send(images[0])
    bench.status(lambda status: 'segmenting' in values_of(status)['doing'])
    for image in images[1:]:
        bench.depth.publish(image)
    # The answer comes while the first frame is being computed.
    bench.set_parameters(method='planes')
    assert not bench.find('labels', images[0])
    np.testing.assert_array_equal(bench.labels_of(images[4]), expected)
    assert bench.find('labels', images[0])
    # Beside the first there is room for one more.
    others = sum(bench.find('labels', image) is not None for image in images[1:4])
    assert others <= 1
    bench.status(lambda status: dropped(status) == before + 3 - others)


def test_frames_come_out_in_their_order(bench, expected):
    """Empty ones are soon done, and may be worked on while one before them is."""
    bench.in_use()
    bench.received['labels'].clear()
    for depth in (None, np.zeros_like(corner_depth(bench.camera))) * 10:
        image = bench.send(bench.image(depth))
        bench.spin(0.01)
    bench.answer('labels', image)
    stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for m in bench.received['labels']]
    assert stamps == sorted(stamps)
    for message in bench.received['labels']:
        labels = np.frombuffer(message.data, np.uint16)
        assert not labels.any() or (labels == expected.ravel()).all()


def test_camera_info_may_be_remapped_and_reliability_overridden(expected):
    depth_topic, info_topic = '/camera/image', '/calibration/camera_info'
    override = f'qos_overrides.{depth_topic}.subscription.reliability:=best_effort'
    remapped = '-r', f'depth/image_rect:={depth_topic}', '-r', f'depth/camera_info:={info_topic}'
    with (
        Bench(*remapped, '-p', override, namespace='robot') as bench,
        bench.listening('labels'),
        bench.advertised(Image, depth_topic) as bench.depth,
        bench.advertised(CameraInfo, info_topic) as bench.camera_info,
    ):
        bench.settled(info_topic, ReliabilityPolicy.RELIABLE)
        np.testing.assert_array_equal(bench.stream(), expected)
        bench.settled(depth_topic, ReliabilityPolicy.BEST_EFFORT)


def test_a_clock_that_stands_still_silences_no_report():
    with Bench(use_sim_time=True, namespace='paused') as bench:
        status = bench.status(lambda status: status.message.startswith('idle: nobody listens'))
        assert status.level == DiagnosticStatus.OK
        with bench.listening('labels'):
            bench.error(f'no depth message on /paused{DEPTH}')
            bench.until(lambda: bench.log().count('no depth message') == 1)
            with bench.camera_on():
                assert bench.segment().any()
