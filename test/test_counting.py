"""Counts of the node: of any size, and told apart from what cannot be."""

import sys

import pytest

from rangeseg_ros.ros import counting
from rangeseg_ros.ros.counting import Losses, Window


@pytest.fixture
def clock(monkeypatch):
    """A clock that tests set."""

    class Clock:
        now = 100.0

    monkeypatch.setattr(counting.time, 'monotonic', lambda: Clock.now)
    return Clock


def test_a_count_of_any_size_takes_no_memory():
    window = Window()
    for count in (2**31 - 1, 2**62):
        window.add(count)
    assert window.recent() == window.total == 2**31 - 1 + 2**62
    assert sys.getsizeof(window._counts) < 2000


def test_recent_events_and_their_rate(clock):
    window = Window()
    for _ in range(31):
        window.add()
        clock.now += 0.1
    assert window.recent() == 31
    assert window.rate() == pytest.approx(10)
    clock.now += counting.WINDOW
    window.add(3)
    assert (window.recent(), window.total, window.rate()) == (3, 34, 0.0)


@pytest.mark.parametrize('count', [2**31 - 1, -(2**31), -1, 0, 10**6])
def test_impossible_loss_reports_count_nothing(count):
    losses = Losses()
    losses.arrived(None)
    losses.report(count)
    assert (losses.implausible, losses.lost.total) == (1, 0)


def test_losses_that_a_camera_can_have_had_are_believed(clock):
    losses = Losses()
    losses.arrived(None)
    clock.now += 1.0
    losses.report(30)
    assert (losses.implausible, losses.lost.total) == (0, 30)


def test_gaps_in_the_numbers_tell_of_unseen_messages():
    losses = Losses()
    assert losses.unseen is None
    for number in (7, 8, 12, 13):
        losses.arrived(number)
    assert losses.unseen == 3
    # Another publisher, which counts from 1 on; then two of them, whose numbers say nothing.
    for number in (1, 2, None, 50, 51):
        losses.arrived(number)
    assert losses.unseen == 3
