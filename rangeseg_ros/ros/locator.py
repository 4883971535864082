"""Where the camera is at each frame: tf, the accelerometer, or the parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.placement import AT_REST, Placement, find_placement
from rangeseg_ros.core.mapping.transforms import Transform, TransformBuffer, TransformError
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.make import TRANSFORMS, message_class, nanoseconds
from rangeseg_ros.messages.motion import insert_transforms
from rangeseg_ros.ros.parameters import NodeConfig
from rangeseg_ros.ros.qos import MatchedSubscription

IMU_TOPIC = 'imu'

TIME_CONSTANT = 0.5
"""Of the low-pass filter, seconds: motions of a robot are shorter, its tilting is slower."""

STANDARD_GRAVITY = 9.80665

NO_MESSAGES = (
    'tf is not read: the package tf2_msgs is not installed; it is part of every ROS installation '
    '(apt install ros-jazzy-tf2-msgs), but there is no wheel of it'
)


class Reading(NamedTuple):
    """Filtered acceleration (3,), m/s^2, in the frame `frame`, at `stamp` nanoseconds."""

    frame: str
    stamp: int
    acceleration: Floats

    def followed_by(self, new: Reading) -> Reading:
        """The new reading, smoothed by this one unless its frame differs or it is earlier."""
        elapsed = (new.stamp - self.stamp) * 1e-9
        if new.frame != self.frame or elapsed < 0:
            return new
        share = -math.expm1(-elapsed / TIME_CONSTANT)
        smooth = self.acceleration + share * (new.acceleration - self.acceleration)
        return new._replace(acceleration=smooth)


class Locator:
    """Listens to what tells where the camera is, while the node listens to depth.

    Any thread may ask; `changed` is called after transforms have come.
    """

    def __init__(self, node: Node, changed: Callable[[], None]) -> None:
        self._node, self._changed = node, changed
        self._imu: MatchedSubscription | None = None
        self._reading: Reading | None = None
        self._tf: list[Any] = []
        self._no_tf = 'tf is not read'
        self._buffer, self._lock = TransformBuffer(), Lock()

    def subscribe(self, config: NodeConfig) -> None:
        """Listen to what the parameters ask for, and to nothing else any more."""
        self.unsubscribe()
        if config.use_imu:
            self._imu = MatchedSubscription(self._node, Imu, IMU_TOPIC, self._on_imu)
        # An accelerometer may be in a frame of its own.
        frames = config.gravity_frame or config.fixed_frame or config.target_frame
        if not (frames or config.use_imu):
            return
        try:
            kind = message_class(TRANSFORMS)
        except ImportError:
            self._no_tf = NO_MESSAGES
            return
        self._no_tf = ''
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, quality in (('/tf', QoSProfile(depth=100)), ('/tf_static', latched)):
            take = partial(self._on_transforms, static=quality is latched)
            self._tf.append(self._node.create_subscription(kind, topic, take, quality))

    def unsubscribe(self) -> None:
        """Listen no more, and forget."""
        if self._imu:
            self._imu.destroy()
        for subscription in self._tf:
            self._node.destroy_subscription(subscription)
        self._imu, self._tf, self._no_tf = None, [], 'tf is not read'
        self._reading, self._buffer = None, TransformBuffer()

    def follow_publishers(self) -> None:
        """Keep the quality of service at what the publishers offer."""
        if self._imu:
            self._imu.follow_publishers()

    def place(self, config: Config, frame: DepthFrame) -> Placement:
        """What is known now of the camera at the stamp of a frame."""

        def lookup(target: str, source: str) -> Transform:
            if self._no_tf:
                raise TransformError(self._no_tf)
            with self._lock:
                return self._buffer.lookup(target, source, frame.stamp)

        imu, reading = self._imu, self._reading
        known = (reading.frame, reading.acceleration) if reading else None
        found = find_placement(config, frame.frame_id, lookup, known)
        if imu and not reading:
            problem = f'{imu.topic}: no acceleration of rest yet'
            self._node.get_logger().warning(problem, throttle_duration_sec=5.0)
            found.asked, found.sources['up'] = True, f'{found.sources["up"]}; {problem}'
        return found

    def delay(self, config: Config, frame: DepthFrame, waited: float) -> float:
        """Seconds for which a frame is to wait for transforms after `waited` seconds."""
        left = config.tf_timeout - waited
        return left if left > 0 and self.place(config, frame).may_come else 0.0

    def _on_transforms(self, message: Any, static: bool) -> None:
        with self._lock:
            problems = insert_transforms(self._buffer, message, static)
        for problem in problems:
            self._node.get_logger().warning(f'{problem}: left out', throttle_duration_sec=5.0)
        self._changed()

    def _on_imu(self, message: Imu) -> None:
        """Take an acceleration of rest, which is upwards (REP 145)."""
        measured = message.linear_acceleration
        acceleration = np.array([measured.x, measured.y, measured.z])
        size = float(np.linalg.norm(acceleration))
        # The first covariance is -1 where there is no accelerometer. What is not finite differs.
        at_rest = abs(size / STANDARD_GRAVITY - 1) <= AT_REST
        if message.linear_acceleration_covariance[0] == -1 or not at_rest:
            return
        new = Reading(message.header.frame_id, nanoseconds(message.header.stamp), acceleration)
        self._reading = self._reading.followed_by(new) if self._reading else new
