"""What is published of a segmented frame, and reported of it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

from rclpy.publisher import Publisher

from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.make import make_rclpy
from rangeseg_ros.messages.motion import odometry_message
from rangeseg_ros.messages.outputs import MAP_OUTPUTS, OUTPUTS, messages_of
from rangeseg_ros.ros.diagnostics import FrameStatistics, FrameTimes
from rangeseg_ros.ros.settings import Settings

_MAP_INTERVAL = 1.0
"""Seconds between messages of the map: it changes with every frame, and is not for control."""


_FIRST = ('drops', 'grid', 'obstacles', 'ground')
"""Outputs that a robot stops for: published before those that people look at."""


class Result(NamedTuple):
    """A segmented frame; `ticks` are the times at which its parts began and ended, seconds."""

    frame: DepthFrame
    image: RangeImage
    segmentation: Segmentation
    start: int
    ticks: list[float]
    target: tuple[str, Transform] | None = None
    map: list[MapPlane] | None = None
    motion: Motion | None = None


class Publication:
    """Publishes results, each output while somebody listens to it.

    Parameters
    ----------
    publishers, map_publishers : mapping
        By the names of `OUTPUTS` and `MAP_OUTPUTS`.
    odometry_publisher : rclpy.publisher.Publisher
    settings : Settings
    statistics : FrameStatistics
    """

    def __init__(
        self,
        publishers: Mapping[str, Publisher],
        map_publishers: Mapping[str, Publisher],
        odometry_publisher: Publisher,
        settings: Settings,
        statistics: FrameStatistics,
    ) -> None:
        self._publishers = publishers
        self._settings = settings
        self._statistics = statistics
        self._map_publishers = map_publishers
        self._odometry_publisher = odometry_publisher
        self._map_time = 0.0

    def map_to_send(self, sequence: SequenceSegmenter) -> list[MapPlane] | None:
        """The planes of the map, once a second while somebody listens."""
        config = sequence.config
        listeners = sum(p.get_subscription_count() for p in self._map_publishers.values())
        now = time.monotonic()
        if not config.map_frame or not listeners or now - self._map_time < _MAP_INTERVAL:
            return None
        self._map_time = now
        return sequence.map.planes

    def publish(self, result: Result) -> None:
        """Publish what somebody listens to, and report the frame."""
        frame, image, found, start, ticks = result[:5]
        doing = self._statistics.activity.now
        header = frame.message.header
        names = (name for name in OUTPUTS if self._publishers[name].get_subscription_count())
        for name, message in messages_of(make_rclpy, header, image, found, result.target, names):
            self._publishers[name].publish(message)
        if result.motion and self._odometry_publisher.get_subscription_count():
            message = odometry_message(make_rclpy, frame.message.header, result.motion)
            self._odometry_publisher.publish(message)
        if result.map is not None:
            doing('publishing the map')
            self._publish_map(result.map, frame.message.header.stamp)
        doing()
        times = [*ticks, time.perf_counter()]
        conversion, compute, publication = (1000 * (end - begin) for begin, end in pairwise(times))
        statistics = self._statistics
        statistics.times = FrameTimes(
            transport=(frame.time - frame.stamp) / 1e6,
            waiting=(start - frame.time) / 1e6,
            conversion=conversion,
            compute=compute,
            publication=publication,
            stages=found.timings,
        )
        statistics.found = found
        # Only what was worked out for a listener.
        known = vars(found)
        statistics.ground = str(known.get('ground', ''))
        statistics.stairs = ', '.join(map(str, known.get('stairs', ())))
        statistics.answered(statistics.published)

    def _publish_map(self, planes: list[MapPlane], stamp: Any) -> None:
        frame = self._settings.wanted.map_frame
        header = make_rclpy('std_msgs/msg/Header', stamp=stamp, frame_id=frame)
        for name, (_, message) in MAP_OUTPUTS.items():
            self._map_publishers[name].publish(message(make_rclpy, header, planes))
