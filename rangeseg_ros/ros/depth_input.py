"""The depth input of the node: images paired with their camera, or clouds."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.messages.cameras import camera_from_message, raw_by_name
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.ros.qos import MatchedSubscription

IMAGE_TOPIC = 'depth/image_rect'
CAMERA_TOPIC = 'depth/camera_info'
POINTS_TOPIC = 'depth/points'


class DepthInput:
    """Subscribes to depth messages and hands on those whose camera is known.

    An image that arrives before its camera_info waits for it; the next image takes its place.

    Parameters
    ----------
    node : rclpy.node.Node
    source : {'image', 'compressed_depth', 'points'}
        The parameter `input`.
    raw : bool
        Whether the images are raw whatever the name of their topic says.
    accept : callable
        Gets every complete frame.
    lost : callable
        Gets the number of depth messages that the middleware lost.

    Attributes
    ----------
    problem : str
        What keeps the last message from being handed on; empty when nothing does.
    last_arrival : float
        Time (monotonic, seconds) of the last depth message, at first of the subscription.
    """

    def __init__(
        self,
        node: Node,
        source: str,
        raw: bool,
        accept: Callable[[DepthFrame], None],
        lost: Callable[[int], None],
    ) -> None:
        self._node = node
        self._accept = accept
        self._waiting: tuple[Any, int] | None = None
        self._camera: Camera | None = None
        self._camera_frame = ''
        self.problem = ''
        self.last_arrival = time.monotonic()
        self._info_subscription: MatchedSubscription | None = None
        if source == 'points':
            self._subscription = MatchedSubscription(
                node, PointCloud2, POINTS_TOPIC, self._on_cloud, lost
            )
            return
        image_topic = node.resolve_topic_name(IMAGE_TOPIC)
        self._raw = raw or raw_by_name(image_topic)
        self._info_subscription = MatchedSubscription(
            node, CameraInfo, _camera_topic(node, image_topic), self._on_camera_info
        )
        if source == 'compressed_depth':
            self._subscription = MatchedSubscription(
                node, CompressedImage, f'{image_topic}/compressedDepth', self._on_image, lost
            )
        else:
            self._subscription = MatchedSubscription(
                node, Image, image_topic, self._on_image, lost
            )

    @property
    def topic(self) -> str:
        """Topic of the depth messages."""
        return self._subscription.topic

    @property
    def publishers(self) -> int:
        """Number of publishers of depth messages."""
        return self._subscription.publishers

    def follow_publishers(self) -> None:
        """Keep the quality of service at what the publishers offer."""
        self._subscription.follow_publishers()
        if self._info_subscription:
            self._info_subscription.follow_publishers()

    def destroy(self) -> None:
        """Unsubscribe."""
        self._subscription.destroy()
        if self._info_subscription:
            self._info_subscription.destroy()

    def _on_cloud(self, message: PointCloud2) -> None:
        self.last_arrival = time.monotonic()
        self._accept(DepthFrame(message, None, self._now()))

    def _on_image(self, message: Image | CompressedImage) -> None:
        self.last_arrival = time.monotonic()
        self._waiting = message, self._now()
        if self._camera is None:
            self._warn(self.problem or f'no camera_info on {self._info_topic()} yet')
        self._hand_on()

    def _on_camera_info(self, info: CameraInfo) -> None:
        try:
            self._camera = camera_from_message(info, self._raw)
            self._camera_frame = info.header.frame_id
        except CameraError as error:
            self._camera = None
            self._warn(f'unusable camera_info on {self._info_topic()}: {error}')
        self._hand_on()

    def _hand_on(self) -> None:
        """Pass the waiting image on when the camera fits it."""
        if self._camera is None or self._waiting is None:
            return
        message, arrival = self._waiting
        camera = self._camera
        # The size of a compressed image is known once it is decoded; the core checks it then.
        if hasattr(message, 'height') and (message.height, message.width) != camera.shape:
            self._warn(
                f'image is {message.width}x{message.height}, '
                f'its camera_info {camera.width}x{camera.height}'
            )
            return
        self.problem = ''
        if message.header.frame_id != self._camera_frame:
            self._node.get_logger().warning(
                f'image is in frame {message.header.frame_id!r}, '
                f'its camera_info in {self._camera_frame!r}',
                throttle_duration_sec=5.0,
            )
        self._waiting = None
        self._accept(DepthFrame(message, camera, arrival))

    def _warn(self, problem: str) -> None:
        self.problem = problem
        self._node.get_logger().warning(problem, throttle_duration_sec=5.0)

    def _info_topic(self) -> str:
        return self._info_subscription.topic if self._info_subscription else ''

    def _now(self) -> int:
        nanoseconds: int = self._node.get_clock().now().nanoseconds
        return nanoseconds


def _camera_topic(node: Node, image_topic: str) -> str:
    """The camera_info beside the image wherever that is remapped to, or where it is itself."""
    default = node.resolve_topic_name(CAMERA_TOPIC, only_expand=True)
    remapped: str = node.resolve_topic_name(CAMERA_TOPIC)
    if remapped != default:
        return remapped
    return f'{image_topic.rpartition("/")[0]}/camera_info'
