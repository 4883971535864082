"""`rangeseg play`: recordings to live topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import click
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from rangeseg_ros import interrupts
from rangeseg_ros.cli import options
from rangeseg_ros.io.recordings import why_unreadable

CLOCK = '/clock'
CLOCK_PERIOD = 0.025
"""Seconds between two times on /clock, as `ros2 bag play` has it."""


@click.command()
@click.argument('bag', type=click.Path(exists=True, path_type=Path))
@click.option(
    '--rate',
    type=options.Finite(min=0, min_open=True),
    default=1.0,
    show_default=True,
    help='Speed: 2 plays twice as fast as recorded.',
)
@click.option('--loop', is_flag=True, help='Start again at the end, until interrupted.')
@click.option('--wait', is_flag=True, help='Start only when every topic has a subscriber.')
@click.option(
    '--delay',
    type=options.Finite(min=0),
    default=1.0,
    show_default=True,
    help='Seconds before the first message, for subscribers to find the topics.',
)
@click.option(
    '--clock',
    is_flag=True,
    help='Publish the time of the recording on /clock, for nodes with use_sim_time.',
)
def command(bag: Path, rate: float, loop: bool, wait: bool, delay: float, clock: bool) -> None:
    """Publish the messages of a rosbag2 on their topics, timed as they were recorded.

    Stamps stay as recorded. Topics are reliable, unless they were recorded as best effort.
    """
    try:
        import rclpy
        from rclpy.duration import Duration
        from rclpy.signals import SignalHandlerOptions
    except ImportError:
        raise click.ClickException(
            'play needs rclpy: source a ROS 2 installation, or install the extra jazzy'
        ) from None
    try:
        reader = Reader(bag)
        reader.open()
    # Readers meet damaged bytes with exceptions of every kind.
    except Exception as error:
        reason = why_unreadable(bag, error)
        raise click.ClickException(f'{bag}: not a readable rosbag2: {reason}') from None
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('rangeseg_play')
    try:
        publishers = _publishers(node, reader.connections)
        if not publishers:
            raise click.ClickException(f'{bag}: no message of a known type')
        publish_time = _clock(node) if clock and CLOCK not in publishers else _silent
        while wait and not all(p.get_subscription_count() for p in publishers.values()):
            interrupts.check()
            time.sleep(0.05)
        time.sleep(delay)
        while True:
            interrupts.check()  # there may be no message
            for topic, data in options.progress(
                _timed(reader, publishers, rate, publish_time), reader.message_count, 'message'
            ):
                publishers[topic].publish(data)
            if not loop:
                break
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=2))
    finally:
        reader.close()
        node.destroy_node()
        rclpy.try_shutdown()


def _publishers(node: Any, connections: list[Connection]) -> dict[str, Any]:
    """Publishers of the topics whose message classes are installed."""
    from rclpy.exceptions import InvalidNamespaceException, InvalidTopicNameException

    from rangeseg_ros.messages.make import message_class

    publishers = {}
    for connection in connections:
        try:
            kind = message_class(connection.msgtype)
        except (ImportError, AttributeError):
            click.echo(f'{connection.topic}: {connection.msgtype} is not installed, left out')
            continue
        if connection.topic not in publishers:
            try:
                publishers[connection.topic] = node.create_publisher(
                    kind, connection.topic, _qos(connection)
                )
            except (InvalidTopicNameException, InvalidNamespaceException):
                click.echo(f'{connection.topic!r} is no topic of ROS 2, left out')
    return publishers


def _qos(connection: Connection) -> Any:
    """Quality of service that the recorded publishers offered."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    offers: Any = getattr(connection.ext, 'offered_qos_profiles', [])
    best_effort = any(offer.reliability.name == 'BEST_EFFORT' for offer in offers)
    latched = any(offer.durability.name == 'TRANSIENT_LOCAL' for offer in offers)
    return QoSProfile(
        depth=10,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _clock(node: Any) -> Callable[[int], None]:
    """Publishes a time in nanoseconds."""
    from rosgraph_msgs.msg import Clock

    publisher = node.create_publisher(Clock, CLOCK, 1)
    message = Clock()

    def publish_time(now: int) -> None:
        message.clock.sec, message.clock.nanosec = divmod(now, 10**9)
        publisher.publish(message)

    return publish_time


def _silent(now: int) -> None:
    pass


def _timed(
    reader: Reader, topics: Collection[str], rate: float, publish_time: Callable[[int], None]
) -> Iterator[tuple[str, bytes]]:
    """Topics and contents of messages when they are due; the time is published meanwhile."""
    start = time.monotonic()
    wanted = [connection for connection in reader.connections if connection.topic in topics]
    for connection, stamp, data in reader.messages(wanted):
        due = start + (stamp - reader.start_time) / 1e9 / rate
        while (left := due - time.monotonic()) > CLOCK_PERIOD:
            publish_time(stamp - round(left * rate * 1e9))
            interrupts.check()
            time.sleep(CLOCK_PERIOD)
        time.sleep(max(0.0, left))
        publish_time(stamp)
        yield connection.topic, bytes(data)
