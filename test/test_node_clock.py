"""Time in the node: a clock that stands still, stamps of another one."""

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from ros_bench import DEPTH, INFO, Bench, values_of

pytestmark = pytest.mark.ros


def test_a_clock_that_stands_still_silences_no_report():
    with Bench('-p', 'use_sim_time:=true', namespace='paused') as bench:
        bench.status(lambda status: status.message.startswith('idle'))
        with bench.listening('labels'):
            dead = bench.status(lambda status: status.level == DiagnosticStatus.ERROR)
            assert f'no depth message on /paused{DEPTH}' in dead.message
            bench.until(lambda: bench.log().count('no depth message') == 1)
            with bench.camera_on(f'/paused{DEPTH}', f'/paused{INFO}'):
                assert bench.segment().any()


def test_the_latency_of_recorded_stamps_is_unknown():
    with (
        Bench('-p', 'stall_timeout:=60.0', namespace='replayed') as bench,
        bench.listening('labels'),
        bench.camera_on(f'/replayed{DEPTH}', f'/replayed{INFO}'),
    ):
        recorded = bench.image()
        recorded.header.stamp.sec = 1
        for image, known in ((recorded, False), (bench.image(), True)):
            bench.segment(image)
            # Of this frame, whose times are counted once it is published.
            values = values_of(
                bench.status(
                    lambda status, known=known: (
                        ('transport (ms)' in values_of(status)) == known
                        and 'latency (ms)' in values_of(status)
                    )
                )
            )
            assert values['latency (ms)'].startswith('unknown') != known
            assert float(values['latency since arrival (ms)']) > 0
