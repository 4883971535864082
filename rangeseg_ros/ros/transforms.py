"""What the node knows of frames: /tf and /tf_static."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from rangeseg_ros.core.mapping.transforms import Transform, TransformBuffer, TransformError
from rangeseg_ros.messages.make import message_class
from rangeseg_ros.messages.transforms import insert_transforms

MISSING = (
    'tf is not read: the package tf2_msgs is not installed; it is part of every ROS installation '
    '(apt install ros-jazzy-tf2-msgs), but there is no wheel of it'
)


class TransformListener:
    """Subscribes to transforms, and looks them up for any thread.

    Parameters
    ----------
    node : rclpy.node.Node
    changed : callable
        Called after transforms have come.

    Attributes
    ----------
    problem : str
        Why there are none; empty when there may be some.
    """

    def __init__(self, node: Node, changed: Callable[[], None]) -> None:
        self._node = node
        self._changed = changed
        self._buffer = TransformBuffer()
        self._lock = Lock()
        self._subscriptions: list[Any] = []
        self.problem = ''
        try:
            kind = message_class('tf2_msgs/msg/TFMessage')
        except ImportError:
            self.problem = MISSING
            return
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, quality, static in (
            ('/tf', QoSProfile(depth=100), False),
            ('/tf_static', latched, True),
        ):
            self._subscriptions.append(
                node.create_subscription(kind, topic, self._taker(static), quality)
            )

    def lookup(self, target: str, source: str, stamp: int) -> Transform:
        """As `TransformBuffer.lookup`."""
        if self.problem:
            raise TransformError(self.problem)
        with self._lock:
            return self._buffer.lookup(target, source, stamp)

    def destroy(self) -> None:
        """Unsubscribe."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _taker(self, static: bool) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            with self._lock:
                problems = insert_transforms(self._buffer, message, static)
            for problem in problems:
                self._node.get_logger().warning(f'{problem}: left out', throttle_duration_sec=5.0)
            self._changed()

        return take
