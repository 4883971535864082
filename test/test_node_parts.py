"""Parts of the node: which camera_info an image gets, order, counts, and the share of the work."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from rangeseg_ros.core.sensing.binning import BUDGETS, widening
from rangeseg_ros.ros import counting
from rangeseg_ros.ros.counting import Losses, Window
from rangeseg_ros.ros.diagnostics import FrameStatistics
from rangeseg_ros.ros.handover import TicketLock
from rangeseg_ros.ros.pace import Pace
from rangeseg_ros.ros.pairing import Found, StampPairing


@pytest.mark.parametrize(
    'events',
    [
        # One of the same stamp wins over a later one.
        'add 1 a, add 2 b, find 1 a own',
        # An image waits for its own once a pair was seen.
        'find 1, add 1 a, find 1 a own, find 2, add 2 b, find 2 b own',
        # One whose own never comes takes the last; others do not wait, until one was too early.
        'add 1 a, find 1 a own, find 2, give up, find 2 a, find 3 a, add 3 c, find 4',
        # Sent once per session, or without a stamp.
        'add 1 a, find 5 a, find 6 a',
        'add 0 a, add 0 b, find 0 b, find 0 b',
        # Ten are kept.
        ', '.join([*(f'add {n} i{n}' for n in range(1, 12)), 'find 1 i11', 'find 2 i2 own']),
    ],
)
def test_which_camera_info_an_image_gets(events):
    pairing = StampPairing()
    for event in events.split(', '):
        what, stamp, *item = event.split()
        if what == 'find':
            expected = Found(item[0], item[1:] == ['own']) if item else None
            assert pairing.find(int(stamp)) == expected, event
        elif what == 'add':
            pairing.add(int(stamp), *item)
        else:
            pairing.give_up()


def test_turns_are_in_order_whoever_is_ready_first():
    order, had = TicketLock(), []
    places = [order.take_ticket() for _ in range(5)]

    def work(place):
        # A turn that fails is over.
        with suppress(ValueError), order.turn(place):
            had.append(place)
            raise ValueError

    with ThreadPoolExecutor(5) as threads:
        threads.map(work, reversed(places))
    assert had == places


@pytest.fixture
def clock(monkeypatch):
    """A clock that tests set."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(counting.time, 'monotonic', lambda: clock.now)
    return clock


def test_recent_events_and_their_rate(clock):
    window = Window()
    for _ in range(31):
        window.add()
        clock.now += 0.1
    assert window.recent() == 31 and window.rate() == pytest.approx(10)
    clock.now += counting.WINDOW
    window.add(2**62)  # takes no more memory than one
    assert (window.recent(), window.total, window.rate()) == (2**62, 2**62 + 31, 0.0)


def test_silence_counts_from_the_first_frame_without_an_answer(clock):
    statistics = FrameStatistics()
    assert statistics.stalled() == 0
    statistics.accepted(0)
    clock.now += 2
    statistics.accepted(1)
    clock.now += 1
    assert statistics.stalled() == 3
    statistics.answered(statistics.refused)
    assert statistics.stalled() == 0
    assert (statistics.received.total, statistics.dropped.total) == (2, 1)


def test_losses_are_believed_that_a_camera_can_have_had(clock):
    for count in (2**31 - 1, -(2**31), -1, 0, 2):
        losses = Losses()
        losses.arrived(None)
        losses.report(count)
        assert (losses.implausible, losses.lost.total) == (1, 0)
    losses.report(1)
    clock.now += 1.0
    losses.report(30)
    assert (losses.implausible, losses.lost.total) == (1, 31)


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


PERIOD = 1 / 30


def budgets(pace, count, full, other=0.002, spread=0.0):
    """Budgets of frames, and seconds they take: `full` with all of the work."""
    told = []
    for seconds in full * np.exp(np.random.default_rng(0).normal(0, spread, count)):
        budget = pace.budget
        refining = seconds * max(budget, 0.32)
        pace.add(refining, other)
        told.append((budget, refining + other))
    return np.transpose(told)


@pytest.mark.parametrize(
    ('rate', 'most', 'times'),
    [
        *((30, 1.0, {'full': full, 'spread': 0.08}) for full in (0.01, 0.02, 0.025)),
        # One slow frame is nothing.
        (30, 1.0, {'full': np.where(np.arange(600) % 100 == 50, 2.0, 0.024)}),
        (0, 0.95, {'full': 3.0, 'other': 5.0}),
    ],
)
def test_all_is_done_where_there_is_time_for_it_or_no_rate_to_hold(rate, most, times):
    assert set(budgets(Pace(rate, most), 600, **times)[0]) == {most}


def test_of_three_frames_two_slow_ones_are_followed_at_once():
    pace = Pace(30, 1.0)
    budgets(pace, 3, 0.02)
    assert budgets(pace, 3, 3.0)[0].tolist() == [1.0, 1.0, BUDGETS[-1]]


@pytest.mark.parametrize('full', np.linspace(0.024, 0.055, 12))
def test_the_rate_is_held_without_chatter(full):
    told, seconds = budgets(Pace(30, 1.0), 1800, full, spread=0.08)
    assert np.mean(seconds[300:] > PERIOD) < 0.1
    assert np.diff(told).astype(bool).sum() <= 4 and np.diff(told[300:]).astype(bool).sum() <= 1


def test_what_cannot_be_held_gets_the_least_and_recovers_at_once():
    pace = Pace(30, 1.0)
    assert budgets(pace, 1000, 10.0)[0, -1] == BUDGETS[-1]
    # Nothing has wound up: each step takes three seconds at least, and the filter one in all.
    recovered = budgets(pace, 600, 0.01)[0].tolist()
    assert recovered.index(1.0) * PERIOD < 3.5 * (len(BUDGETS) - 1) + 1
    assert all(recovered.count(step) * PERIOD >= 3 for step in BUDGETS)


def test_what_else_takes_time_counts():
    for other, step in ((0.014, 1), (1.0, -1)):
        assert budgets(Pace(30, 1.0), 300, 0.02, other)[0, -1] == BUDGETS[step]


@pytest.mark.parametrize('most', [0.97, 0.95, 0.8, 0.3, 0.0])
def test_work_budget_is_the_most(most):
    assert set(budgets(Pace(30, most), 300, 0.001)[0]) == {most}
    slow, _ = budgets(Pace(30, most), 300, 1.0)
    assert slow[-1] == min(most, BUDGETS[-1])
    assert all(widening(a) != widening(b) for a, b in pairwise(slow) if a != b)


@pytest.mark.parametrize('rate', [0.01, 1.0, 1000.0])
@pytest.mark.parametrize('refining', [0.0, 1e-9, 1.0, 1e6])
def test_any_times_give_a_budget(rate, refining):
    pace = Pace(rate, 1.0)
    for other in (0.0, 1e-9, 1e6, 0.0):
        pace.add(refining, other)
        assert pace.budget in BUDGETS
