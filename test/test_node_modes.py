"""The node under a lifecycle manager, beside another one, and at a target rate."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from processes import python
from ros_bench import Bench, benches, values_of

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.core.sensing.binning import BUDGETS
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera

pytestmark = pytest.mark.ros


def test_a_managed_node_works_while_it_is_active():
    with Bench(managed=True, namespace='managed') as bench:
        bench.until(lambda: 'waits for a lifecycle manager' in bench.log())
        client = bench.node.create_client(ChangeState, '/managed/segment_planes/change_state')

        def change(kind, success=True):
            assert bench.call(client, transition=Transition(id=kind)).success == success

        def subscribed():
            return bench.node.count_subscribers('/managed/depth/image_rect')

        with bench.listening('labels'):
            bench.spin(1.0)
            assert not subscribed()
            change(Transition.TRANSITION_ACTIVATE, success=False)
            change(Transition.TRANSITION_CONFIGURE)
            change(Transition.TRANSITION_CONFIGURE, success=False)
            bench.until(lambda: 'is not possible in this state' in bench.log())
            for end in Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVE_SHUTDOWN:
                change(Transition.TRANSITION_ACTIVATE)
                bench.until(subscribed)
                change(end)
                bench.until(lambda: not subscribed())


def test_two_nodes_in_one_process():
    code = """
import os
import rclpy
from rangeseg_ros.ros.node import SegmentPlanes
rclpy.init()
for node in [SegmentPlanes(namespace=name) for name in ('front', 'rear')]:
    rclpy.spin_once(node, timeout_sec=1.0)
    topics = [publisher.topic_name for publisher in node.publishers]
    print(*(topic for topic in topics if topic.endswith('/labels')), flush=True)
os._exit(0)  # while kernels are being compiled
"""
    done = python(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [f'/{name}/segment_planes/labels' for name in ('front', 'rear')]


node, bench = benches('labels', 'status', camera=kinect_camera(161, 121))


def test_every_frame_is_made_again_with_what_it_records(bench):
    depth = simulate(kinect_room(2), Kinect(0), bench.camera, seed=2).depth
    image = RangeImage.from_depth(depth, bench.camera)
    offline = {step: Segmenter(Config(work_budget=step)).segment(image).labels for step in BUDGETS}
    assert all((offline[1.0] != offline[step]).any() for step in BUDGETS[1:])

    def next_budget():
        image = bench.image(depth)
        labels = bench.segment(image)
        message = bench.answer('status', image)
        assert message.header == image.header
        recorded = float(values_of(message.status[0])['work_budget'])
        np.testing.assert_array_equal(labels, offline[recorded])
        return recorded

    assert [next_budget() for _ in range(3)] == [1.0] * 3
    # No machine does it: the least of the work, with steps on the way.
    bench.set_parameters(target_rate=1000.0)
    assert bench.until(lambda: next_budget() == BUDGETS[-1])
    bench.status(lambda status: values_of(status)['work_budget'] == f'{BUDGETS[-1]:g}')
    # What every machine does, at once: the steering begins anew.
    bench.set_parameters(target_rate=0.001)
    assert [next_budget() for _ in range(3)] == [1.0] * 3
    bench.set_parameters(target_rate=0.0, work_budget=BUDGETS[1])
    assert [next_budget() for _ in range(2)] == [BUDGETS[1]] * 2
