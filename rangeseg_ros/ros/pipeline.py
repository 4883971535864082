"""Frames to published results: one thread segments, another publishes what was found before."""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from threading import Thread
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher

from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.placement import Placement
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.runtime.memory import give_back_memory
from rangeseg_ros.core.runtime.pace import Pace
from rangeseg_ros.core.segmenter import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.make import make_rclpy
from rangeseg_ros.messages.motion import odometry_message
from rangeseg_ros.messages.outputs import IN_TARGET, MAP_OUTPUTS, OUTPUTS, in_target
from rangeseg_ros.ros.diagnostics import FrameStatistics, FrameTimes
from rangeseg_ros.ros.latest import HandOver
from rangeseg_ros.ros.locator import Locator
from rangeseg_ros.ros.settings import Settings
from rangeseg_ros.ros.waiting import WaitingRoom

_MAP_INTERVAL = 1.0
"""Seconds between messages of the map: it changes with every frame, and is not for control."""


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


class Pipeline:
    """Segments the newest frame whenever it is free.

    Parameters
    ----------
    node : rclpy.node.Node
    publishers, map_publishers : mapping
        By the names of `OUTPUTS` and `MAP_OUTPUTS`; what nobody subscribes to is not made.
    settings : Settings
    statistics : FrameStatistics
    odometry_publisher : rclpy.publisher.Publisher

    Attributes
    ----------
    locator : Locator
        Tells where the camera is.
    """

    def __init__(
        self,
        node: Node,
        publishers: Mapping[str, Publisher],
        settings: Settings,
        statistics: FrameStatistics,
        map_publishers: Mapping[str, Publisher],
        odometry_publisher: Publisher,
    ) -> None:
        self._node = node
        self._publishers = publishers
        self._settings = settings
        self._statistics = statistics
        self._map_publishers = map_publishers
        self._odometry_publisher = odometry_publisher
        self._map_time = 0.0
        self._frames: WaitingRoom[DepthFrame] = WaitingRoom(self._delay)
        self.locator = Locator(node, self._frames.look_again)
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
        dropped = self._frames.put(frame)
        self._statistics.accepted(replaced=dropped > 0)
        if dropped > 1:
            self._statistics.dropped.add(dropped - 1)

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
        given = config
        sequence = SequenceSegmenter(config)
        pace = Pace(config.target_rate, config.work_budget)
        while taken := self._frames.take():
            began = time.perf_counter()
            frame, dropped = taken
            if dropped:
                self._statistics.dropped.add(dropped)
            # Here and not where parameters change, so that one frame is of one configuration.
            if (config := self._settings.in_use()) is None:
                return
            if (config.target_rate, config.work_budget) != (pace.rate, pace.most):
                pace = Pace(config.target_rate, config.work_budget)
            if config is not given or pace.budget != sequence.config.work_budget:
                given = config
                sequence.config = replace(config, work_budget=pace.budget)
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
                refining = sum(result.segmentation.timings.values()) / 1000
                pace.add(refining, time.perf_counter() - began - refining)
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
        at = self.locator.place(sequence.config, frame)
        found = sequence.segment(image, frame.stamp, at.up, at.pose, at.height)
        self._tell(sequence, at)
        ticks.append(time.perf_counter())
        doing()
        target = (sequence.config.target_frame, at.target) if at.target else None
        planes = self._map_to_send(sequence)
        return Result(frame, image, found, start, ticks, target, planes, sequence.motion)

    def _delay(self, frame: DepthFrame, waited: float) -> float:
        return self.locator.delay(self._settings.wanted, frame, waited)

    def _tell(self, sequence: SequenceSegmenter, at: Placement) -> None:
        """Report where up and the frames come from."""
        statistics, config = self._statistics, sequence.config
        statistics.sources = dict(at.sources)
        statistics.missing = '; '.join(f'{what} {why}' for what, why in at.missing.items())
        if config.map_frame:
            count = len(sequence.map)
            anew = f', begun anew: {why}' if (why := sequence.map.begun_anew) else ''
            statistics.sources['map'] = f'{count} planes in {config.map_frame}{anew}'
        if sequence.motion:
            statistics.sources['odometry'] = f'{sequence.motion.held} planes'
        if statistics.missing:
            self._node.get_logger().warning(statistics.missing, throttle_duration_sec=5.0)

    def _map_to_send(self, sequence: SequenceSegmenter) -> list[MapPlane] | None:
        """The planes of the map, once a second while somebody listens."""
        config = sequence.config
        listeners = sum(p.get_subscription_count() for p in self._map_publishers.values())
        now = time.monotonic()
        if not config.map_frame or not listeners or now - self._map_time < _MAP_INTERVAL:
            return None
        self._map_time = now
        return sequence.map.planes

    def _publish_all(self) -> None:
        before = 0
        while result := self._results.take():
            size = result.image.inverse.size
            try:
                self._publish(result)
            except Exception as error:
                self._fail(error)
            del result
            # Now, as nothing holds the larger frame any more.
            if size < before:
                give_back_memory()
            before = size

    def _publish(self, result: Result) -> None:
        frame, image, found, start, ticks = result[:5]
        doing = self._statistics.publishing.now
        here = frame.message.header, found
        there = in_target(make_rclpy, *here, *result.target) if result.target else here
        for name, output in OUTPUTS.items():
            publisher = self._publishers[name]
            if publisher.get_subscription_count():
                doing(f'publishing {name}')
                if not self._settings.ready_for(name):
                    return
                header, shown = there if name in IN_TARGET else here
                if output.serialised:
                    publisher.publish(output.serialised(header, image, shown))
                else:
                    publisher.publish(output.message(make_rclpy, header, image, shown))
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
        statistics.planes = len(found.planes)
        statistics.reason = found.reason
        statistics.sensor = str(found.sensor)
        statistics.work_budget = found.work_budget
        statistics.tilt = str(found.tilt or '')
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
