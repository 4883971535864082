"""Frames to published results: one thread segments, another publishes what was found before."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from itertools import pairwise
from threading import Thread
from typing import Any, NamedTuple

from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher

from rangeseg_ros.core.segmenter import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.distortion import corrected
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.make import make_rclpy
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.ros.diagnostics import FrameStatistics, FrameTimes
from rangeseg_ros.ros.latest import HandOver, Latest
from rangeseg_ros.ros.settings import Settings


class Result(NamedTuple):
    """A segmented frame; `ticks` are the times at which its parts began and ended, seconds."""

    frame: DepthFrame
    image: RangeImage
    segmentation: Segmentation
    start: int
    ticks: list[float]


class Pipeline:
    """Segments the newest frame whenever it is free.

    Parameters
    ----------
    node : rclpy.node.Node
    publishers : mapping
        By the names of `OUTPUTS`; what nobody subscribes to is not made.
    settings : Settings
    statistics : FrameStatistics
    up : callable
        Upward vector in a frame of that name, or None.
    """

    def __init__(
        self,
        node: Node,
        publishers: Mapping[str, Publisher],
        settings: Settings,
        statistics: FrameStatistics,
        up: Callable[[str], NDArray | None],
    ) -> None:
        self._node = node
        self._publishers = publishers
        self._settings = settings
        self._statistics = statistics
        self._up = up
        self._frames: Latest[DepthFrame] = Latest()
        # Every result is published: the segmentation waits rather than replace one.
        self._results: HandOver[Result] = HandOver()
        self._threads = [
            Thread(target=self._segment_all, name='segmentation', daemon=True),
            Thread(target=self._publish_all, name='publication', daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def put(self, frame: DepthFrame) -> None:
        """Take a frame in place of one that waits."""
        self._statistics.accepted(replaced=self._frames.put(frame))

    def stop(self, patience: float) -> bool:
        """Let the frame in hand be finished; False when it takes more seconds than that."""
        self._frames.close()
        self._results.close()
        end = time.monotonic() + patience
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))
        return not any(thread.is_alive() for thread in self._threads)

    def _segment_all(self) -> None:
        if (config := self._settings.in_use()) is None:
            return
        sequence = SequenceSegmenter(config)
        while frame := self._frames.take():
            # Here and not where parameters change, so that one frame is of one configuration.
            if (config := self._settings.in_use()) is None:
                return
            if config is not sequence.config:
                sequence.config = config
            try:
                result = self._segment(sequence, frame)
                self._statistics.problem = ''
            except ValueError as error:
                self._refuse(str(error))
            # Whatever one frame does to the segmenter, the next one gets its chance.
            except Exception as error:
                self._fail(error)
            else:
                self._results.put(result)
                # What the next frame needs memory for.
                del result

    def _segment(self, sequence: SequenceSegmenter, frame: DepthFrame) -> Result:
        doing = self._statistics.activity.now
        doing('converting the message')
        ticks = [time.perf_counter()]
        start = self._node.get_clock().now().nanoseconds
        image = corrected(frame.range_image(), sequence.config)
        ticks.append(time.perf_counter())
        doing(f'segmenting {image.shape[1]}x{image.shape[0]} pixels')
        found = sequence.segment(image, frame.stamp, self._up(frame.frame_id))
        ticks.append(time.perf_counter())
        doing()
        return Result(frame, image, found, start, ticks)

    def _publish_all(self) -> None:
        while result := self._results.take():
            try:
                self._publish(result)
            except Exception as error:
                self._fail(error)

    def _publish(self, result: Result) -> None:
        frame, image, found, start, ticks = result
        doing = self._statistics.publishing.now
        for name, output in OUTPUTS.items():
            publisher = self._publishers[name]
            if publisher.get_subscription_count():
                doing(f'publishing {name}')
                publisher.publish(output.message(make_rclpy, frame.message.header, image, found))
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
        statistics.planes = len(found.planes)
        statistics.reason = found.reason
        statistics.answered(statistics.published)

    def _refuse(self, problem: str) -> None:
        self._statistics.problem = problem
        self._statistics.answered(self._statistics.refused)
        self._statistics.activity.now()
        self._node.get_logger().warning(f'frame refused: {problem}', throttle_duration_sec=5.0)

    def _fail(self, error: Any) -> None:
        if not self._node.context.ok():
            return  # publishing has ended
        self._refuse(f'{type(error).__name__}: {error}')
        self._node.get_logger().error(
            ''.join(traceback.format_exception(error)), throttle_duration_sec=5.0
        )
