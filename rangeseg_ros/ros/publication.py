"""What is published of a segmented frame, and reported of it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

from rclpy.publisher import Publisher

from rangeseg_ros.core.mapping.placement import Placement
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.make import header_of, make_rclpy
from rangeseg_ros.messages.motion import odometry_message
from rangeseg_ros.messages.outputs import MAP_OUTPUTS, OUTPUTS, messages_of
from rangeseg_ros.ros.diagnostics import FrameStatistics, FrameTimes
from rangeseg_ros.ros.settings import Settings

_MAP_INTERVAL = 1.0
"""Seconds between messages of the map: it changes with every frame, and is not for control."""


class Segmented(NamedTuple):
    """A segmented frame, and where the camera was.

    `start` is when the work on it began, by the clock of the node, nanoseconds; `ticks` are the
    times at which its parts began and ended, seconds.
    """

    frame: DepthFrame
    image: RangeImage
    found: Segmentation
    at: Placement
    start: int
    ticks: list[float]


class Publication:
    """Publishes results, each topic (by its name) while somebody listens to it."""

    def __init__(
        self, publishers: Mapping[str, Publisher], settings: Settings, statistics: FrameStatistics
    ) -> None:
        self._publishers = publishers
        self._settings = settings
        self._statistics = statistics
        self._map_time = 0.0

    def publish(self, done: Segmented, sequence: SequenceSegmenter) -> None:
        """Publish what somebody listens to, and report the frame."""
        frame, image, found, at, start, ticks = done
        header, config = frame.message.header, sequence.config
        target = (config.target_frame, at.target) if at.target else None
        for name, message in messages_of(
            make_rclpy, header, image, found, target, self._listened()
        ):
            self._publishers[name].publish(message)
        if sequence.motion and self._has_listeners('odometry'):
            message = odometry_message(make_rclpy, header, sequence.motion)
            self._publishers['odometry'].publish(message)
        now = time.monotonic()
        if (
            config.map_frame
            and now - self._map_time >= _MAP_INTERVAL
            and any(map(self._has_listeners, MAP_OUTPUTS))
        ):
            self._statistics.activity.begin('publishing the map')
            self._map_time = now
            fixed = header_of(make_rclpy, header.stamp, config.map_frame)
            for name, (_, map_message) in MAP_OUTPUTS.items():
                planes = map_message(make_rclpy, fixed, sequence.map.planes)
                self._publishers[name].publish(planes)
        self._statistics.activity.begin()
        times = [*ticks, time.perf_counter()]
        conversion, compute, publication = (1000 * (end - begin) for begin, end in pairwise(times))
        waits = (frame.time - frame.stamp) / 1e6, (start - frame.time) / 1e6
        self._statistics.done(
            found, FrameTimes(*waits, conversion, compute, publication, found.timings)
        )

    def _has_listeners(self, name: str) -> bool:
        return bool(self._publishers[name].get_subscription_count())

    def _listened(self) -> Iterator[str]:
        """Names of the outputs that somebody listens to, each once its kernels are there."""
        for name in self._settings.ready_first(OUTPUTS):
            if self._has_listeners(name):
                self._statistics.activity.begin(f'publishing {name}')
                if not self._settings.ready_for(name):
                    return
                yield name
