"""`rangeseg play`: recordings to live topics, where no `ros2 bag play` is installed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
from rosbags.interfaces import Connection

from rangeseg_ros import interrupts
from rangeseg_ros.cli import options
from rangeseg_ros.extras import import_extra
from rangeseg_ros.io.recordings import BagError, Lost, Recording, is_rosbag1

CLOCK = '/clock'
CLOCK_PERIOD = 0.025
"""Seconds between two times on /clock, as `ros2 bag play` has it."""


@click.command()
@click.argument('bag', type=options.EXISTING)
@options.positive('--rate', 1.0, 'Speed: 2 plays twice as fast as recorded.')
@click.option('--loop', is_flag=True, help='Start again at the end, until interrupted.')
@click.option('--wait', is_flag=True, help='Start only when every topic has a subscriber.')
@click.option('--clock', is_flag=True, help='Publish the time of the recording on /clock.')
def command(bag: Path, rate: float, loop: bool, wait: bool, clock: bool) -> None:
    """Publish the messages of a rosbag2 on their topics, timed as they were recorded.

    Stamps stay as recorded. Topics are reliable, unless they were recorded as best effort. The
    first message comes after a second, for subscribers to find the topics.
    """
    rclpy = import_extra('rclpy')
    no_handlers = import_extra('rclpy.signals').SignalHandlerOptions.NO
    recording = Recording(bag)
    if is_rosbag1(bag):
        raise click.ClickException(f'{bag}: a bag of ROS 1, not a rosbag2')
    rclpy.init(args=[], signal_handler_options=no_handlers)
    node = rclpy.create_node('rangeseg_play')
    try:
        publishers = _publishers(node, recording.connections)
        if not publishers:
            raise click.ClickException(f'{bag}: no message of a known type')
        times = None
        if clock and CLOCK not in publishers:
            times = node.create_publisher(import_extra('rosgraph_msgs.msg').Clock, CLOCK, 1)
        while wait and not all(p.get_subscription_count() for p in publishers.values()):
            interrupts.check()
            time.sleep(0.05)
        time.sleep(1.0)
        while True:
            interrupts.check()  # there may be no message
            messages = _timed(recording, set(publishers), rate, times)
            count = sum(recording.counts[topic] for topic in publishers)
            for topic, data in options.progress(messages, count, 'message'):
                publishers[topic].publish(data)
            if not loop:
                break
        for publisher in publishers.values():
            publisher.wait_for_all_acked(import_extra('rclpy.duration').Duration(seconds=2))
    except BagError as error:
        raise click.ClickException(f'{bag}: {error}') from None
    finally:
        recording.close()
        node.destroy_node()
        rclpy.try_shutdown()


def _publishers(node: Any, connections: list[Connection]) -> dict[str, Any]:
    """Publishers of the topics whose message classes are installed."""
    from rclpy.exceptions import InvalidNamespaceException, InvalidTopicNameException

    from rangeseg_ros.messages.make import message_class

    publishers: dict[str, Any] = {}
    for connection in connections:
        topic, kind = connection.topic, connection.msgtype
        try:
            publishers[topic] = publishers.get(topic) or node.create_publisher(
                message_class(kind), topic, _offered(connection)
            )
        except (ImportError, AttributeError):
            click.echo(f'{topic}: {kind} is not installed, left out')
        except (InvalidTopicNameException, InvalidNamespaceException):
            click.echo(f'{topic!r} is no topic of ROS 2, left out')
    return publishers


def _offered(connection: Connection) -> Any:
    """Quality of service that the recorded publishers offered."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    offers: Any = getattr(connection.ext, 'offered_qos_profiles', [])
    quality = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
    if any(offer.reliability.name == 'BEST_EFFORT' for offer in offers):
        quality.reliability = ReliabilityPolicy.BEST_EFFORT
    if any(offer.durability.name == 'TRANSIENT_LOCAL' for offer in offers):
        quality.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return quality


def _timed(
    recording: Recording, topics: set[str], rate: float, times: Any
) -> Iterator[tuple[str, bytes]]:
    """Topics and contents of messages when they are due; `times` publishes the time meanwhile."""

    def publish_time(now: int) -> None:
        if times is not None:
            message = times.msg_type()
            message.clock.sec, message.clock.nanosec = divmod(now, 10**9)
            times.publish(message)

    start, first = time.monotonic(), None
    for record in recording.records(topics):
        if isinstance(record, Lost):
            raise BagError(record.reason)
        stamp = record.time
        first = stamp if first is None else first
        due = start + (stamp - first) / 1e9 / rate
        while (left := due - time.monotonic()) > CLOCK_PERIOD:
            publish_time(stamp - round(left * rate * 1e9))
            interrupts.check()
            time.sleep(CLOCK_PERIOD)
        time.sleep(max(0.0, left))
        publish_time(stamp)
        yield record.topic, record.data
