"""What /diagnostics says of the ground, of stairs and of a camera that is tilted."""

import time
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus

from rangeseg_ros.ros.diagnostics import FrameStatistics


def status(**found):
    statistics = FrameStatistics()
    for name, value in found.items():
        setattr(statistics, name, value)
    source = SimpleNamespace(
        last_arrival=time.monotonic(), problem='', pairing='', topic='/depth', publishers=1
    )
    return statistics.status('segment_planes', source, 3600.0)


def test_ground_and_stairs_are_told():
    found = status(ground='ground 1.20 m below, confidence 0.98', stairs='up 4 x 0.17 / 0.28 m')
    values = {value.key: value.value for value in found.values}
    assert values['ground'] == 'ground 1.20 m below, confidence 0.98'
    assert values['stairs'] == 'up 4 x 0.17 / 0.28 m'
    assert found.level == DiagnosticStatus.OK


def test_a_tilt_is_a_warning():
    found = status(tilt='the camera looks tilted by 20 degrees')
    assert found.level == DiagnosticStatus.WARN
    assert found.message == 'the camera looks tilted by 20 degrees'
