"""What /diagnostics says of the ground, of stairs, of doubtful input and of what is lost."""

import time
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus

from rangeseg_ros.core.sensing.verdict import Verdict
from rangeseg_ros.ros.counting import Losses, Window
from rangeseg_ros.ros.diagnostics import FrameStatistics


def status(**found):
    statistics = FrameStatistics()
    for name, value in found.items():
        setattr(statistics, name, value)
    source = SimpleNamespace(
        last_arrival=time.monotonic(), problem='', pairing='', topic='/depth', publishers=1
    )
    source.loss_hint = lambda: 'a larger buffer'
    return statistics.status('segment_planes', source, 3600.0)


def test_ground_and_stairs_are_told():
    told = {'ground': 'ground 1.20 m below, confidence 0.98', 'stairs': ['up 4 x 0.17 / 0.28 m']}
    found = status(found=result(**told))
    values = {value.key: value.value for value in found.values}
    assert values['ground'] == 'ground 1.20 m below, confidence 0.98'
    assert values['stairs'] == 'up 4 x 0.17 / 0.28 m'
    assert found.level == DiagnosticStatus.OK


def result(verdict=Verdict(), **worked_out):  # noqa: B008
    known = {'reason': '', 'sensor': '', 'work_budget': 1.0, 'tilt': '', **worked_out}
    return SimpleNamespace(planes=[1, 2, 3], verdict=verdict, **known)


def test_a_wrong_unit_is_an_error_and_an_enlarged_image_a_warning():
    for reason, level in (
        ('millimetres in floats', DiagnosticStatus.ERROR),
        ('range instead of z', DiagnosticStatus.ERROR),
        ('enlarged x 4', DiagnosticStatus.WARN),
    ):
        found = status(found=result(verdict=Verdict((reason,), ('What it is.',))))
        assert found.level == level and found.message == 'What it is.'
        assert {value.key: value.value for value in found.values}['input'] == 'What it is.'


def test_lost_messages_are_a_warning_with_their_share_and_what_helps():
    received, losses = Window(), Losses()
    received.add(3)
    losses.lost.add(1)
    found = status(received=received, losses=losses)
    assert found.level == DiagnosticStatus.WARN
    assert found.message == '25% lost on /depth: a larger buffer'
