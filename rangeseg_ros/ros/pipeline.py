"""Frames to published results: two at a time, published in their order."""

from __future__ import annotations

import time
import traceback
from dataclasses import replace
from threading import Lock, Thread
from typing import Any, NamedTuple

import cv2
from rclpy.node import Node

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.placement import Placement, UpFilter
from rangeseg_ros.core.runtime.threads import sharing_cores
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.ros.diagnostics import FrameStatistics
from rangeseg_ros.ros.handover import LatestReady, TicketLock
from rangeseg_ros.ros.locator import Locator
from rangeseg_ros.ros.memory import give_back_memory
from rangeseg_ros.ros.pace import Pace
from rangeseg_ros.ros.publication import Publication, Segmented
from rangeseg_ros.ros.settings import Settings

_AT_ONCE = 2
"""Frames that are worked on at a time: one that comes before the last is done need not wait."""


class Work(NamedTuple):
    """A frame that is being worked on, and what with; `began` in seconds."""

    ticket: int
    frame: DepthFrame
    segmenter: Segmenter
    pace: Pace
    began: float


class Pipeline:
    """Segments the newest frame whenever one of its threads is free.

    `locator` tells where the camera is.
    """

    def __init__(
        self, node: Node, publication: Publication, settings: Settings, statistics: FrameStatistics
    ) -> None:
        self._node = node
        self._publication = publication
        self._settings = settings
        self._statistics = statistics
        self._frames: LatestReady[DepthFrame] = LatestReady(self._delay)
        self.locator = Locator(node, self._frames.recheck)
        self._turns = TicketLock()
        self._beginning = Lock()
        # Of the frame that was begun last.
        self._pace = Pace(0.0, 1.0)
        self._given: Config | None = None
        self._segmenter = Segmenter()
        # Of the frame that was done last.
        self._sequence: SequenceSegmenter | None = None
        self._jumps = 0
        self._ended = 0.0
        self._up = UpFilter()
        self._size = 0
        self._threads = [
            Thread(target=self._work_all, name='segmentation', daemon=True)
            for _ in range(_AT_ONCE if cv2.getNumThreads() > 1 else 1)
        ]
        for thread in self._threads:
            thread.start()

    def put(self, frame: DepthFrame) -> None:
        """Take a frame in place of one that waits."""
        self._statistics.accepted(replaced=self._frames.put(frame))

    def stop(self, patience: float) -> bool:
        """Let the frames in hand be finished; False when it takes more seconds than that."""
        self._frames.close()
        end = time.monotonic() + patience
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))
        return not any(thread.is_alive() for thread in self._threads)

    def _work_all(self) -> None:
        if self._settings.in_use() is None:
            return
        while work := self._begin():
            segmented: Segmented | Exception
            try:
                with sharing_cores():
                    segmented = self._segment(work)
            except Exception as error:
                segmented = error
            with self._turns.turn(work.ticket), sharing_cores():
                before = self._size
                self._finish(work, segmented)
                # What the next frame needs memory for, and the system after a larger frame.
                del work, segmented
                if self._size < before:
                    give_back_memory()

    def _begin(self) -> Work | None:
        """Take the newest frame, and the configuration that all of it is to be of."""
        with self._beginning:
            if not (taken := self._frames.take()):
                return None
            began = time.perf_counter()
            frame, dropped = taken
            if dropped:
                self._statistics.dropped.add(dropped)
            if (config := self._settings.in_use()) is None:
                return None
            pace = self._pace
            if (config.target_rate, config.work_budget) != (pace.rate, pace.most):
                pace = self._pace = Pace(config.target_rate, config.work_budget)
            budget = pace.budget
            if config is not self._given or budget != self._segmenter.config.work_budget:
                self._given = config
                self._segmenter = Segmenter(replace(config, work_budget=budget))
            return Work(self._turns.take_ticket(), frame, self._segmenter, pace, began)

    def _segment(self, work: Work) -> Segmented:
        """Do what needs no other frame."""
        config, frame = work.segmenter.config, work.frame
        doing = self._statistics.activity.begin
        doing('converting the message')
        ticks = [time.perf_counter()]
        start = self._node.get_clock().now().nanoseconds
        image = corrected(frame.range_image(), config)
        ticks.append(time.perf_counter())
        doing(f'segmenting {image.shape[1]}x{image.shape[0]} pixels')
        at = self.locator.place(config, frame)
        return Segmented(frame, image, work.segmenter.segment(image), at, start, ticks)

    def _finish(self, work: Work, segmented: Segmented | Exception) -> None:
        """Do what takes frames one after the other, publishing included."""
        try:
            if isinstance(segmented, Exception):
                raise segmented
            done, sequence = self._follow(work, segmented)
        except ValueError as error:
            self._refuse(str(error))
        # Whatever one frame does, the next one gets its chance.
        except Exception as error:
            self._fail(error)
        else:
            self._statistics.problem = ''
            self._size = done.image.inverse.size
            try:
                self._publication.publish(done, sequence)
            except Exception as error:
                self._fail(error)
            self._set_pace(work, done.found)

    def _follow(self, work: Work, segmented: Segmented) -> tuple[Segmented, SequenceSegmenter]:
        """Find the planes of the frames before in a frame."""
        config, stamp = work.segmenter.config, work.frame.stamp
        if self._sequence is None:
            self._sequence = SequenceSegmenter(config)
        elif config is not self._sequence.config:
            self._sequence.config = config
        sequence = self._sequence
        at = self._up.settle(segmented.at, stamp, config, sequence.motion)
        placed = stamp, at.up, at.pose, at.height, at.up_sd
        found = sequence.segment(segmented.image, *placed, segmented.found)
        lost = at.lost
        if not lost and found.tilt:
            lost = f'no terrain: {found.tilt}'
        self._statistics.no_terrain = lost
        if lost:
            found = replace(found, source=None)
            self._node.get_logger().warning(lost, throttle_duration_sec=5.0)
        self._tell(sequence, at)
        segmented.ticks.append(time.perf_counter())
        return segmented._replace(found=found, at=at), sequence

    def _set_pace(self, work: Work, found: Segmentation) -> None:
        """Take up how long a frame took, after the one before if they were worked on at once."""
        ended = time.perf_counter()
        seconds = ended - max(work.began, self._ended)
        self._ended = ended
        refining = sum(found.timings.values()) / 1000 / (ended - work.began)
        work.pace.add(seconds * refining, seconds * (1 - refining))

    def _delay(self, frame: DepthFrame, waited: float) -> float:
        return self.locator.delay(self._settings.wanted, frame, waited)

    def _tell(self, sequence: SequenceSegmenter, at: Placement) -> None:
        """Report where up and the frames come from."""
        statistics, config = self._statistics, sequence.config
        sources = dict(at.sources)
        statistics.missing = '; '.join(f'{what} {why}' for what, why in at.missing.items())
        if config.map_frame:
            count = len(sequence.map)
            anew = f', begun anew: {why}' if (why := sequence.map.begun_anew) else ''
            sources['map'] = f'{count} planes in {config.map_frame}{anew}'
            if doubts := sequence.map.doubts:
                sources['poses'] = doubts[-1]
            if len(sequence.map.jumps) > self._jumps:
                self._node.get_logger().warning(str(sequence.map.jumps[-1][1]))
            self._jumps = len(sequence.map.jumps)
        if sequence.motion:
            sources['odometry'] = f'{sequence.motion.held} planes'
        statistics.sources = sources
        if statistics.missing:
            self._node.get_logger().warning(statistics.missing, throttle_duration_sec=5.0)

    def _refuse(self, problem: str) -> None:
        self._statistics.problem = problem
        self._statistics.answered(self._statistics.refused)
        self._statistics.activity.begin()
        self._node.get_logger().warning(f'frame refused: {problem}', throttle_duration_sec=5.0)

    def _fail(self, error: Any) -> None:
        if not self._node.context.ok():
            return  # publishing has ended
        self._refuse(f'{type(error).__name__}: {error}')
        self._node.get_logger().error(
            ''.join(traceback.format_exception(error)), throttle_duration_sec=5.0
        )
