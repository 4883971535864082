"""The node: depth messages in; what `OUTPUTS` lists out, each while somebody listens."""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
import warnings
from contextlib import suppress
from itertools import pairwise
from threading import Thread

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.time import Time

from rangeseg_ros.core.config import ConfigError
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.distortion import corrected
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.make import make_rclpy, message_class
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.ros.depth_input import DepthInput
from rangeseg_ros.ros.diagnostics import FrameStatistics, FrameTimes
from rangeseg_ros.ros.gravity import Gravity
from rangeseg_ros.ros.latest import Latest
from rangeseg_ros.ros.parameters import NodeConfig, bind


class SegmentPlanes(Node):
    """Segments the newest depth message whenever it is free, while any output is subscribed.

    The executor's thread receives, answers parameter requests and reports; one worker thread
    computes and publishes.
    """

    def __init__(self) -> None:
        super().__init__('segment_planes')
        self._config = bind(self, self._configure)
        self._sequence = SequenceSegmenter(self._config)
        self._input: DepthInput | None = None
        self._gravity: Gravity | None = None
        self._frames: Latest[DepthFrame] = Latest()
        self._statistics = FrameStatistics()
        events = PublisherEventCallbacks(matched=lambda event: self._follow_demand())
        overriding = QoSOverridingOptions.with_default_policies()
        self._outputs = {
            name: self.create_publisher(
                message_class(output.kind),
                f'~/{name}',
                QoSProfile(depth=5),
                event_callbacks=events,
                qos_overriding_options=overriding,
            )
            for name, output in OUTPUTS.items()
        }
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # A clock that stands still, of a simulation or a recording, must not silence the reports.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(1.0, self._look_around, clock=steady)
        self._worker = Thread(target=self._work, name='segmentation', daemon=True)
        self._worker.start()

    def stop(self, patience: float) -> bool:
        """Let the worker finish the frame in hand; False when it takes more seconds than that."""
        self._frames.close()
        self._worker.join(patience)
        return not self._worker.is_alive()

    def _configure(self, config: NodeConfig) -> None:
        before, self._config = self._config, config
        restart = any(
            getattr(config, name) != getattr(before, name) for name in ('input', 'raw', 'use_imu')
        )
        if restart and self._input:
            self._unsubscribe()
            self._follow_demand()

    def _follow_demand(self) -> None:
        """Subscribe to the input when the first listener comes, unsubscribe with the last."""
        listeners = sum(output.get_subscription_count() for output in self._outputs.values())
        if listeners and self._input is None:
            config, losses = self._config, self._statistics.losses
            self._input = DepthInput(self, config.input, config.raw, self._accept, losses)
            self._gravity = Gravity(self) if self._config.use_imu else None
            self._statistics.problem = ''
        elif not listeners and self._input:
            self._unsubscribe()

    def _unsubscribe(self) -> None:
        for subscribed in (self._input, self._gravity):
            if subscribed:
                subscribed.destroy()
        self._input = self._gravity = None

    def _accept(self, frame: DepthFrame) -> None:
        self._statistics.accepted(replaced=self._frames.put(frame))

    def _work(self) -> None:
        # What goes wrong here will again on the first frame, which is where it is reported.
        with suppress(Exception):
            self._sequence.warm_up()
        while frame := self._frames.take():
            try:
                self._segment(frame)
                self._statistics.problem = ''
            except ValueError as error:
                self._refuse(str(error))
            # Whatever one frame does to the segmenter, the next one gets its chance.
            except Exception as error:
                if not self.context.ok():
                    return  # publishing has ended
                self._refuse(f'{type(error).__name__}: {error}')
                self.get_logger().error(traceback.format_exc(), throttle_duration_sec=5.0)

    def _segment(self, frame: DepthFrame) -> None:
        doing = self._statistics.activity.now
        doing('converting the message')
        ticks = [time.perf_counter()]
        start = self.get_clock().now().nanoseconds
        header = frame.message.header
        # Here and not where parameters change, so that one frame is of one configuration.
        if (config := self._config) is not self._sequence.config:
            self._sequence.config = config
        image = corrected(frame.range_image(), config)
        ticks.append(time.perf_counter())
        doing(f'segmenting {image.shape[1]}x{image.shape[0]} pixels')
        gravity = self._gravity
        up = gravity.up(header.frame_id) if gravity else None
        result = self._sequence.segment(image, Time.from_msg(header.stamp).nanoseconds, up)
        ticks.append(time.perf_counter())
        doing('publishing')
        for name, output in OUTPUTS.items():
            publisher = self._outputs[name]
            if publisher.get_subscription_count():
                publisher.publish(output.message(make_rclpy, header, image, result))
        ticks.append(time.perf_counter())
        conversion, compute, publication = (1000 * (end - begin) for begin, end in pairwise(ticks))
        self._statistics.times = FrameTimes(
            transport=(frame.time - Time.from_msg(header.stamp).nanoseconds) / 1e6,
            waiting=(start - frame.time) / 1e6,
            conversion=conversion,
            compute=compute,
            publication=publication,
            stages=result.timings,
        )
        self._statistics.planes = len(result.planes)
        self._statistics.reason = result.reason
        self._statistics.answered(self._statistics.published)
        doing()

    def _refuse(self, problem: str) -> None:
        self._statistics.problem = problem
        self._statistics.answered(self._statistics.refused)
        self._statistics.activity.now()
        self.get_logger().warning(f'frame refused: {problem}', throttle_duration_sec=5.0)

    def _look_around(self) -> None:
        """Once a second: follow the publishers, report."""
        if self._input:
            self._input.follow_publishers()
            if lost := self._statistics.lost(self._input):
                self.get_logger().warning(f'{lost} (said once; see /diagnostics)', once=True)
        if self._gravity:
            self._gravity.follow_publishers()
        name = self.get_fully_qualified_name().lstrip('/')
        status = self._statistics.status(name, self._input, self._config.stall_timeout)
        report = DiagnosticArray(status=[status])
        report.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(report)


def main() -> None:
    """Run the node until it is told to stop; bad parameters end it with exit code 2."""
    # rclpy's own handler ends the spinning. Without this, Python's would raise KeyboardInterrupt
    # on top, wherever the code is, and again on every further Ctrl-C.
    signal.signal(signal.SIGINT, lambda number, stack: None)
    rclpy.init()
    finished = True
    try:
        node = SegmentPlanes()
    except (ConfigError, ParameterException) as error:
        print(f'segment_planes: {error}', file=sys.stderr)
        rclpy.try_shutdown()
        sys.exit(2)
    # What the core warns of, such as a lens that is left out: once each.
    warnings.showwarning = lambda message, *where: node.get_logger().warning(str(message))
    try:
        rclpy.spin(node)
    except Exception:
        # The signal ends the context between any two steps of rclpy.
        if rclpy.ok():
            raise
    finally:
        finished = node.stop(patience=2.0)
    node.destroy_node()
    rclpy.try_shutdown()
    if not finished:
        # A thread inside a solver that takes minutes may not outlive the interpreter.
        os._exit(0)


if __name__ == '__main__':
    main()
