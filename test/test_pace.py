"""A share of the work that holds a frame rate, by simulated times."""

import math
from itertools import pairwise

import numpy as np
import pytest

from rangeseg_ros.core.runtime.work import STEPS, step_within
from rangeseg_ros.ros.pace import Pace

PERIOD = 1 / 30


def budgets(pace, count, full, other=0.002, spread=0.0, real=lambda budget: max(budget, 0.32)):
    """Budgets of frames, and seconds they take: `full` with all of the work."""
    rng = np.random.default_rng(0)
    told = []
    for number in range(count):
        budget = pace.budget
        seconds = full(number) if callable(full) else full
        refining = seconds * real(budget) * math.exp(rng.normal(0, spread))
        pace.add(refining, other)
        told.append((budget, refining + other))
    return told


def changes(told):
    return sum(before[0] != after[0] for before, after in pairwise(told))


@pytest.mark.parametrize('full', [0.01, 0.02, 0.025])
def test_all_is_done_where_there_is_time_for_it(full):
    assert {budget for budget, _ in budgets(Pace(30, 1.0), 300, full, spread=0.08)} == {1.0}


def test_off_is_off():
    told = budgets(Pace(0, 0.95), 100, 3.0, other=5.0)
    assert {budget for budget, _ in told} == {0.95}


@pytest.mark.parametrize('full', np.linspace(0.024, 0.055, 12))
def test_the_rate_is_held_without_chatter(full):
    told = budgets(Pace(30, 1.0), 1800, full, spread=0.08)
    late = [seconds > PERIOD for _, seconds in told[300:]]
    assert np.mean(late) < 0.1
    assert changes(told) <= 4 and changes(told[300:]) <= 1


@pytest.mark.parametrize('full', np.linspace(0.026, 0.05, 5))
def test_no_more_is_left_out_than_it_takes(full):
    """The next step up would have been late, but for what is not known so well."""
    (budget, _) = budgets(Pace(30, 1.0), 900, full)[-1]
    assert budget * full + 0.002 <= PERIOD
    above = [step for step in STEPS if step > budget]
    assert not above or 1.15 * 1.1 * (above[-1] * full + 0.002) > PERIOD


def test_what_cannot_be_held_gets_the_least_and_recovers_at_once():
    pace = Pace(30, 1.0)
    told = budgets(pace, 1000, 10.0)
    assert told[-1][0] == STEPS[-1]
    # Nothing has wound up: each step takes three seconds at least, and the filter one in all.
    recovered = budgets(pace, 600, 0.01)
    assert [b for b, _ in recovered].index(1.0) * PERIOD < 3.5 * (len(STEPS) - 1) + 1


def test_what_else_takes_time_counts():
    assert budgets(Pace(30, 1.0), 300, 0.02, other=0.014)[-1][0] == STEPS[1]
    assert budgets(Pace(30, 1.0), 300, 0.02, other=1.0)[-1][0] == STEPS[-1]


def test_one_slow_frame_is_nothing():
    told = budgets(Pace(30, 1.0), 600, lambda number: 2.0 if number % 100 == 50 else 0.024)
    assert {budget for budget, _ in told} == {1.0}


@pytest.mark.parametrize('most', [0.97, 0.95, 0.8, 0.3, 0.0])
def test_work_budget_is_the_most(most):
    fast = budgets(Pace(30, most), 300, 0.001)
    assert {budget for budget, _ in fast} == {most}
    slow = budgets(Pace(30, most), 300, 1.0)
    assert slow[-1][0] == min(most, STEPS[-1])
    assert all(step_within(a[0]) != step_within(b[0]) for a, b in pairwise(slow) if a[0] != b[0])


@pytest.mark.parametrize('rate', [0.01, 1.0, 1000.0])
@pytest.mark.parametrize('refining', [0.0, 1e-9, 1.0, 1e6])
def test_any_times_give_a_budget(rate, refining):
    pace = Pace(rate, 1.0)
    for other in (0.0, 1e-9, 1e6, 0.0):
        pace.add(refining, other)
        assert pace.budget in STEPS
