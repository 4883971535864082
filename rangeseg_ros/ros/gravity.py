"""Which way is up, from an accelerometer."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Imu

from rangeseg_ros.ros.qos import MatchedSubscription

IMU_TOPIC = 'imu'

TIME_CONSTANT = 0.5
"""Of the low-pass filter, seconds: motions of a robot are shorter, its tilting is slower."""

STANDARD_GRAVITY = 9.80665
TOLERANCE = 0.1
"""Relative difference to standard gravity from which an acceleration is not that of rest."""


class Reading(NamedTuple):
    """Filtered acceleration (3,), m/s^2, in the frame `frame`, at `stamp` nanoseconds."""

    frame: str
    stamp: int
    acceleration: NDArray[np.float64]

    def followed_by(self, new: Reading) -> Reading:
        """The new reading smoothed by this one; as it is in another frame or earlier in time."""
        elapsed = (new.stamp - self.stamp) * 1e-9
        if new.frame != self.frame or elapsed < 0:
            return new
        share = -math.expm1(-elapsed / TIME_CONSTANT)
        smooth = self.acceleration + share * (new.acceleration - self.acceleration)
        return new._replace(acceleration=smooth)


class Gravity:
    """Subscribes to an accelerometer: at rest it measures an acceleration upwards (REP 145).

    Parameters
    ----------
    node : rclpy.node.Node
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._reading: Reading | None = None
        self._subscription = MatchedSubscription(node, Imu, IMU_TOPIC, self._on_imu)

    @property
    def reading(self) -> tuple[str, NDArray[np.float64]] | None:
        """Frame of the accelerometer and the upward vector (3,) in it; None before the first."""
        reading = self._reading
        if reading is None:
            self._node.get_logger().warning(
                f'{self._subscription.topic}: no acceleration of rest yet',
                throttle_duration_sec=5.0,
            )
            return None
        return reading.frame, reading.acceleration

    def follow_publishers(self) -> None:
        """Keep the quality of service at what the publishers offer."""
        self._subscription.follow_publishers()

    def destroy(self) -> None:
        """Unsubscribe."""
        self._subscription.destroy()

    def _on_imu(self, message: Imu) -> None:
        measured = message.linear_acceleration
        acceleration = np.array([measured.x, measured.y, measured.z])
        size = float(np.linalg.norm(acceleration))
        # The first covariance is -1 where there is no accelerometer. What is not finite differs.
        at_rest = abs(size / STANDARD_GRAVITY - 1) <= TOLERANCE
        if message.linear_acceleration_covariance[0] == -1 or not at_rest:
            return
        header = message.header
        stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
        new = Reading(header.frame_id, stamp, acceleration)
        self._reading = self._reading.followed_by(new) if self._reading else new
