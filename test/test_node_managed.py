"""A lifecycle manager decides when the node works; several nodes fit into one process."""

import subprocess
import sys

import pytest

pytest.importorskip('rclpy')

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from ros_bench import Bench

pytestmark = pytest.mark.ros


def test_a_managed_node_works_while_it_is_active():
    arguments = '-p', 'managed:=true', '-p', 'qos_overrides./scan.subscription.depth:=1'
    with Bench(*arguments, namespace='managed') as bench:
        bench.until(lambda: 'waits for a lifecycle manager' in bench.log())
        assert '(of another topic?), ignored' in bench.log()
        service = '/managed/segment_planes/change_state'
        client = bench.node.create_client(ChangeState, service)

        def change(kind):
            bench.until(client.service_is_ready)
            future = client.call_async(ChangeState.Request(transition=Transition(id=kind)))
            bench.until(future.done)
            assert future.result().success

        def subscribed():
            return bench.node.count_subscribers('/managed/depth/image_rect')

        with bench.listening('labels'):
            bench.spin(1.0)
            assert not subscribed()
            change(Transition.TRANSITION_CONFIGURE)
            change(Transition.TRANSITION_ACTIVATE)
            bench.until(subscribed)
            change(Transition.TRANSITION_DEACTIVATE)
            bench.until(lambda: not subscribed())


def test_two_nodes_in_one_process():
    code = """
import os, sys
import rclpy
from rangeseg_ros.ros.node import SegmentPlanes
rclpy.init()
nodes = [SegmentPlanes(namespace=name) for name in ('front', 'rear')]
executor = rclpy.executors.SingleThreadedExecutor()
for node in nodes:
    executor.add_node(node)
executor.spin_once(1.0)
print(*(node.get_fully_qualified_name() for node in nodes))
print(*(publisher.topic_name for node in nodes for publisher in node.publishers
        if publisher.topic_name.endswith('/labels')))
sys.stdout.flush()
os._exit(0)  # while kernels are being compiled
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[:2] == ['/front/segment_planes', '/rear/segment_planes']
    assert done.stdout.split()[2:] == [
        '/front/segment_planes/labels',
        '/rear/segment_planes/labels',
    ]
