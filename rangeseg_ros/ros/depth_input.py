"""The depth input of the node: images paired with their camera, or clouds."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from rangeseg_ros.core.sensing.camera import CameraError
from rangeseg_ros.messages.cameras import camera_from_message, raw_by_name
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.images import PIXEL_TYPES
from rangeseg_ros.messages.make import nanoseconds
from rangeseg_ros.ros.counting import Losses
from rangeseg_ros.ros.pairing import StampPairing
from rangeseg_ros.ros.qos import MatchedSubscription

IMAGE_TOPIC = 'depth/image_rect'
CAMERA_TOPIC = 'depth/camera_info'
POINTS_TOPIC = 'depth/points'
_KINDS = {'image': Image, 'compressed_depth': CompressedImage, 'points': PointCloud2}

SEGMENT_SIZE = 512 * 1024
"""Of the shared memory of Fast DDS by default, bytes; larger best-effort messages get lost."""
PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
PROFILE_HINT = (
    'they do not fit the default shared-memory segment of Fast DDS; set '
    f'{PROFILE_VARIABLE} to share/rangeseg_ros/params/fastdds_large_images.xml for publisher, '
    'node and listeners of images'
)


class DepthInput:
    """Subscribes to depth messages and hands on to `accept` those whose camera is known.

    An image that arrives before its camera_info waits for it; the next image takes its place.
    Which camera_info is an image's own: `StampPairing`. `source` and `raw` are parameters of the
    node; `losses` counts the depth messages that arrive and those that are lost. `pairing` says by
    what the last image got its camera_info, `problem` what keeps the last message from being
    handed on; `last_arrival` is the time (monotonic, seconds) of the last depth message, at first
    of the subscription.
    """

    def __init__(
        self,
        node: Node,
        source: str,
        raw: bool,
        accept: Callable[[DepthFrame], None],
        losses: Losses,
    ) -> None:
        self._node = node
        self._accept = accept
        self._waiting: tuple[Any, int] | None = None
        self._cameras = StampPairing()
        self._largest = 0
        self.pairing = ''
        self.problem = ''
        self.last_arrival = time.monotonic()
        topic, *info_topics = input_topics(node, source)
        self._raw = raw or raw_by_name(topic)
        self._infos = [
            MatchedSubscription(node, CameraInfo, info_topic, self._on_camera_info)
            for info_topic in info_topics
        ]
        kind = _KINDS[source]
        self.subscription = MatchedSubscription(node, kind, topic, self._on_message, losses)

    @property
    def topic(self) -> str:
        """Topic of the depth messages."""
        return self.subscription.topic

    def loss_hint(self) -> str:
        """What may help against lost depth messages; empty when nothing is known to."""
        if not get_rmw_implementation_identifier().startswith('rmw_fastrtps'):
            return ''
        if 0 < self._largest <= SEGMENT_SIZE:
            return ''
        if PROFILE_VARIABLE in os.environ:
            return f'{PROFILE_VARIABLE} is set for the node; the publisher needs it as well'
        if not self._largest:
            return f'if they are over 512 KiB: {PROFILE_HINT}'
        return f'messages over 512 KiB: {PROFILE_HINT}'

    def follow_publishers(self) -> None:
        """Keep the quality of service at what the publishers offer."""
        for subscription in (self.subscription, *self._infos):
            subscription.follow_publishers()

    def destroy(self) -> None:
        """Unsubscribe."""
        for subscription in (self.subscription, *self._infos):
            subscription.destroy()

    def _on_message(self, message: Image | CompressedImage | PointCloud2) -> None:
        self.last_arrival = time.monotonic()
        self._largest = max(self._largest, len(message.data))
        arrival = int(self._node.get_clock().now().nanoseconds)
        if not self._infos:
            self._accept(DepthFrame(message, None, arrival))
            return
        if self._waiting:
            self._cameras.give_up()
            self._hand_on()
        self._waiting = message, arrival
        self._hand_on()

    def _on_camera_info(self, info: CameraInfo) -> None:
        self._cameras.add(nanoseconds(info.header.stamp), info)
        self._hand_on()

    def _hand_on(self) -> None:
        """Pass the waiting image on when its camera is there and fits it."""
        if self._waiting is None:
            return
        message, arrival = self._waiting
        (info,) = self._infos
        found = self._cameras.find(nanoseconds(message.header.stamp))
        if found is None:
            if (encoding := getattr(message, 'encoding', 'mono16')) not in PIXEL_TYPES:
                self._warn(f'encoding {encoding!r} is no depth image')
            elif not self._cameras.by_stamp:
                self._warn(f'no camera_info on {info.topic} yet')
            return
        try:
            camera = camera_from_message(found.item, self._raw)
        except CameraError as error:
            self._warn(f'unusable camera_info on {info.topic}: {error}')
            return
        frame = found.item.header.frame_id
        # The size of a compressed image is known once it is decoded; the core checks it then.
        if hasattr(message, 'height') and (message.height, message.width) != camera.shape:
            self._warn(
                f'image is {message.width}x{message.height}, '
                f'its camera_info {camera.width}x{camera.height}'
            )
            return
        self.problem = ''
        self.pairing = 'of the stamp of the image' if found.exact else 'the last one received'
        if message.header.frame_id != frame:
            self._node.get_logger().warning(
                f'image is in frame {message.header.frame_id!r}, its camera_info in {frame!r}',
                throttle_duration_sec=5.0,
            )
        self._waiting = None
        self._accept(DepthFrame(message, camera, arrival))

    def _warn(self, problem: str) -> None:
        self.problem = problem
        self._node.get_logger().warning(problem, throttle_duration_sec=5.0)


def input_topics(node: Node, source: str) -> list[str]:
    """Topics that `DepthInput` subscribes to: the depth, and of images the camera_info.

    That is beside the image wherever that is remapped to, or where it is remapped to itself.
    """
    if source == 'points':
        return [node.resolve_topic_name(POINTS_TOPIC)]
    image = node.resolve_topic_name(IMAGE_TOPIC)
    info = node.resolve_topic_name(CAMERA_TOPIC)
    if info == node.resolve_topic_name(CAMERA_TOPIC, only_expand=True):
        info = f'{image.rpartition("/")[0]}/camera_info'
    return [image + ('/compressedDepth' if source == 'compressed_depth' else ''), info]
