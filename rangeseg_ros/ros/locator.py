"""Where the camera is at each frame: tf, the accelerometer, or the parameters."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.placement import Placement, find_placement
from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.ros.gravity import Gravity
from rangeseg_ros.ros.parameters import NodeConfig
from rangeseg_ros.ros.transforms import TransformListener


class Locator:
    """Listens to what tells where the camera is, while the node listens to depth.

    Parameters
    ----------
    node : rclpy.node.Node
    changed : callable
        Called after transforms have come.
    """

    def __init__(self, node: Node, changed: Callable[[], None]) -> None:
        self._node = node
        self._changed = changed
        self._gravity: Gravity | None = None
        self._transforms: TransformListener | None = None

    def subscribe(self, config: NodeConfig) -> None:
        """Listen to what the parameters ask for."""
        self._gravity = Gravity(self._node) if config.use_imu else None
        frames = config.gravity_frame or config.fixed_frame or config.target_frame
        # An accelerometer may be in a frame of its own.
        if frames or config.use_imu:
            self._transforms = TransformListener(self._node, self._changed)

    def unsubscribe(self) -> None:
        """Listen no more."""
        for subscribed in (self._gravity, self._transforms):
            if subscribed:
                subscribed.destroy()
        self._gravity = self._transforms = None

    def follow_publishers(self) -> None:
        """Keep the quality of service at what the publishers offer."""
        if self._gravity:
            self._gravity.follow_publishers()

    def place(self, config: Config, frame: DepthFrame) -> Placement:
        """What is known now of the camera at the stamp of a frame."""
        transforms, gravity = self._transforms, self._gravity

        def lookup(target: str, source: str) -> Transform:
            if transforms is None:
                raise TransformError('tf is not read')
            return transforms.lookup(target, source, frame.stamp)

        return find_placement(config, frame.frame_id, lookup, gravity.reading if gravity else None)

    def delay(self, config: Config, frame: DepthFrame, waited: float) -> float:
        """Seconds for which a frame is to wait for transforms after `waited` seconds."""
        left = config.tf_timeout - waited
        return left if left > 0 and self.place(config, frame).may_come else 0.0
