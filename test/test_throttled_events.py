"""Events of publishers, looked for seldom."""

from threading import Event

import pytest

pytest.importorskip('rclpy')

import rclpy
import ros_bench  # noqa: F401 - gives DDS a domain of its own
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Empty

from rangeseg_ros.ros.throttled_events import ThrottledCallbackGroup


@pytest.fixture
def context():
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


@pytest.mark.ros
def test_events_wait_while_messages_come(context):
    came, group = [], ThrottledCallbackGroup(interval=1e9)
    node, other = (rclpy.create_node(name, context=context) for name in ('node', 'other'))
    events = PublisherEventCallbacks(matched=lambda event: came.append(event.current_count))
    publisher = node.create_publisher(
        Empty, 'topic', 5, event_callbacks=events, callback_group=group
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def listen():
        """The listener, once the publisher has it."""
        subscription = other.create_subscription(Empty, 'topic', lambda message: None, 5)
        while not publisher.get_subscription_count():
            executor.spin_once(timeout_sec=0.01)
        return subscription

    def spin_until_it_came():
        while not came:
            executor.spin_once(timeout_sec=0.01)

    listen()
    spin_until_it_came()
    group.message_came()
    assert group.can_execute(publisher.event_handlers[0])  # the first has nothing before it
    group.message_came()
    came.clear()
    listen()
    for _ in range(20):
        executor.spin_once(timeout_sec=0.01)
    assert not came
    group.look()
    spin_until_it_came()


def test_the_interval_is_kept(monkeypatch):
    group = ThrottledCallbackGroup(interval=0.1)
    event, looked = Event(), []
    group.add_entity(event)
    for now in (5.0, 5.05, 5.09, 5.1, 5.15, 5.25):
        monkeypatch.setattr(
            'rangeseg_ros.ros.throttled_events.time.monotonic', lambda now=now: now
        )
        group.message_came()
        looked.append(group.can_execute(event))
    assert looked == [True, False, False, True, False, True]
