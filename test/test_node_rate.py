"""`target_rate` over real DDS: every frame says what it was made with, and that makes it again."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from ros_bench import Bench, values_of

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.core.runtime.work import STEPS
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

pytestmark = pytest.mark.ros


@pytest.fixture(scope='module')
def bench():
    with (
        Bench(camera=kinect_camera(161, 121)) as bench,
        bench.listening('labels', 'status'),
        bench.camera_on(),
    ):
        yield bench


@pytest.fixture(scope='module')
def depth(bench):
    return simulate_kinect(kinect_room(2), bench.camera, seed=2).depth


def budget_of(bench, image):
    """The share of the work that a frame was given, as recorded with it."""
    message = bench.until(lambda: bench.find('status', image))
    assert message.header == image.header
    (status,) = message.status
    return float(values_of(status)['work_budget'])


def test_every_frame_is_made_again_with_what_it_records(bench, depth):
    offline = {}
    for step in STEPS:
        image = RangeImage.from_depth(depth, bench.camera)
        offline[step] = Segmenter(Config(work_budget=step)).segment(image).labels
    assert all((offline[1.0] != offline[step]).any() for step in STEPS[1:])

    def next_budget():
        image = bench.image(depth)
        labels = bench.segment(image)
        recorded = budget_of(bench, image)
        np.testing.assert_array_equal(labels, offline[recorded])
        return recorded

    assert [next_budget() for _ in range(3)] == [1.0] * 3
    # No machine does it: the least of the work, with steps on the way.
    assert bench.set_parameters(target_rate=1000.0)[0].successful
    assert bench.until(lambda: next_budget() == STEPS[-1])
    bench.status(lambda status: values_of(status)['work_budget'] == f'{STEPS[-1]:g}')
    # What every machine does, at once: the steering begins anew.
    assert bench.set_parameters(target_rate=0.001)[0].successful
    assert [next_budget() for _ in range(3)] == [1.0] * 3
    assert bench.set_parameters(target_rate=0.0, work_budget=STEPS[1])[0].successful
    assert [next_budget() for _ in range(2)] == [STEPS[1]] * 2
    assert bench.set_parameters(work_budget=1.0)[0].successful


def test_a_rate_is_for_the_shortcuts_of_planes(bench):
    result = bench.set_parameters(atomically=True, target_rate=5.0, method='normals')
    assert not result.successful and 'target_rate is for method planes' in result.reason
