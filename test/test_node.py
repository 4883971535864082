"""The node over real DDS: what it publishes, when, and by which quality of service."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from ros_bench import Bench
from sensor_msgs.msg import CameraInfo, Image


@pytest.fixture(scope='module')
def bench():
    bench = Bench()
    bench.depth = bench.advertise(Image, '/depth/image_rect')
    bench.camera_info = bench.advertise(CameraInfo, '/depth/camera_info')
    yield bench
    code, errors = bench.close()
    assert code == 0 and 'Traceback' not in errors, errors


def test_labels_have_the_header_and_the_size_of_the_depth_image(bench):
    bench.listen('labels')
    bench.until(lambda: bench.depth.get_subscription_count())
    bench.until(lambda: bench.camera_info.get_subscription_count())
    bench.camera_info.publish(bench.info())
    image = bench.image()
    bench.depth.publish(image)
    labels = bench.labels_of(image)
    assert labels.header == image.header
    assert (labels.height, labels.width, labels.step) == (120, 160, 320)
    assert labels.encoding == 'mono16' and labels.is_bigendian == 0
    values = np.frombuffer(labels.data, np.uint16)
    assert values.shape == (160 * 120,)
