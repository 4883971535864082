"""The node: depth messages in; what `OUTPUTS` lists out, each while somebody listens."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from operator import attrgetter
from typing import Any, NoReturn

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    ParameterException,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions, install_signal_handlers

from rangeseg_ros.core.options import ConfigError
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.make import ODOMETRY, message_class
from rangeseg_ros.messages.outputs import MAP_OUTPUTS, OUTPUTS
from rangeseg_ros.ros.arguments import check_arguments, check_parameters, logging_arguments
from rangeseg_ros.ros.depth_input import DepthInput, input_topics
from rangeseg_ros.ros.diagnostics import FrameStatistics
from rangeseg_ros.ros.locator import IMU_TOPIC
from rangeseg_ros.ros.parameters import bind
from rangeseg_ros.ros.pipeline import Pipeline
from rangeseg_ros.ros.publication import Publication
from rangeseg_ros.ros.settings import Settings
from rangeseg_ros.ros.throttled_events import ThrottledCallbackGroup

_BAD_NAMES = (InvalidNodeNameException, InvalidNamespaceException)


# Settings whose change renews the subscriptions to frames, and to poses.
_input_settings = attrgetter('input', 'raw')
_pose_settings = attrgetter('use_imu', 'gravity_frame', 'fixed_frame', 'target_frame')
# Seconds until a listener is noticed while frames come: none that a person would.
_EVENT_INTERVAL = 0.1


class SegmentPlanes(LifecycleNode):
    """Segments the newest depth message whenever it is free, while any output is subscribed.

    The executor's thread receives, answers parameter requests and reports; the threads of
    `Pipeline` compute and publish, and that of `Settings` has kernels compiled.

    A managed node with the parameter `managed`; else it is configured and active at once. The
    arguments are those of `rclpy.node.Node`, such as `namespace`: several fit into one process.
    """

    def __init__(self, node_name: str = 'segment_planes', **node_kwargs: Any) -> None:
        super().__init__(node_name, **node_kwargs)
        check_parameters(self, sys.argv)
        config = bind(self, lambda config: self._settings.want(config))
        self._config = config
        self._input: DepthInput | None = None
        self._silent = self._active = False
        self._statistics = FrameStatistics()
        self._throttled = ThrottledCallbackGroup(_EVENT_INTERVAL)
        newest = QoSProfile(depth=5)
        # Late listeners get the last map.
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        topics = {name: (output.kind, newest) for name, output in OUTPUTS.items()}
        topics |= {name: (kind, latched) for name, (kind, _) in MAP_OUTPUTS.items()}
        topics['odometry'] = ODOMETRY, newest
        self._outputs = {name: self._publisher(name, *what) for name, what in topics.items()}
        self._diagnostics = self.create_publisher(
            DiagnosticArray, '/diagnostics', 10, callback_group=self._throttled
        )
        # A clock that stands still, of a simulation or a recording, must not silence the reports.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(1.0, self._look_around, clock=steady)
        (self._manager,) = (s for s in self.services if s.service_name.endswith('/change_state'))
        self._change_state, self._manager.callback = self._manager.callback, self._on_transition
        # What follows a change of parameters is done by the executor, as are all subscriptions.
        self._changed = self.create_guard_condition(self._configure)
        self._settings = Settings(config, self._on_compiling, self._changed.trigger)
        publication = Publication(self._outputs, self._settings, self._statistics)
        self._pipeline = Pipeline(self, publication, self._settings, self._statistics)
        if config.managed:
            self.get_logger().info('waits for a lifecycle manager')
        else:
            self.trigger_configure()
            self.trigger_activate()

    def _publisher(self, name: str, kind: str, quality: QoSProfile) -> Publisher:
        return self.create_publisher(
            message_class(kind),
            f'~/{name}',
            quality,
            event_callbacks=PublisherEventCallbacks(matched=lambda event: self._follow_demand()),
            callback_group=self._throttled,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Follow the listeners from now on."""
        self._active = True
        self.get_logger().info(self._waits_for())
        self._follow_demand()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe; the frame in hand is still published."""
        self._active = False
        self._follow_demand()
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_deactivate

    def _on_transition(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Refuse transitions that the state does not have: rclpy would end the process."""
        try:
            answer: ChangeState.Response = self._change_state(request, response)
            return answer
        except RuntimeError:
            refusal = f'transition {request.transition.id} is not possible in this state'
            self.get_logger().warning(refusal)
            response.success = False
            return response

    def stop(self, patience: float) -> bool:
        """Let the frame in hand be finished; False when it takes more seconds than that."""
        self._settings.close()
        return self._pipeline.stop(patience) and not self._settings.busy

    def _waits_for(self) -> str:
        outputs = ', '.join(f'~/{name}' for name in self._outputs)
        topics = ' and '.join(input_topics(self, self._config.input))
        if self._config.use_imu:
            topics += f', up from {self.resolve_topic_name(IMU_TOPIC)}'
        return f'will subscribe to {topics} once somebody listens to one of {outputs}'

    def _on_compiling(self, progress: str) -> None:
        if progress:
            self.get_logger().info(progress, throttle_duration_sec=2.0)
        elif self._statistics.compiling:
            self.get_logger().info('kernels are compiled')
        self._statistics.compiling = progress

    def _configure(self) -> None:
        """Follow the configuration that has come into use."""
        before, config = self._config, self._settings.in_use()
        if config is None:
            return
        self._config = config
        if self._input and _input_settings(config) != _input_settings(before):
            self._unsubscribe()
            self._follow_demand()
        # No frame is lost for it.
        elif self._input and _pose_settings(config) != _pose_settings(before):
            self._pipeline.locator.subscribe(config)

    def _follow_demand(self) -> None:
        """Subscribe to the input when the first listener comes, unsubscribe with the last."""
        listeners = self._active and any(
            publisher.get_subscription_count() for publisher in self._outputs.values()
        )
        if listeners and self._input is None:
            config, losses = self._config, self._statistics.losses
            self._input = DepthInput(self, config.input, config.raw, self._accept, losses)
            self._pipeline.locator.subscribe(config)
            self._statistics.problem = ''
        elif not listeners and self._input:
            self._unsubscribe()

    def _accept(self, frame: DepthFrame) -> None:
        self._throttled.message_came()
        self._pipeline.put(frame)

    def _unsubscribe(self) -> None:
        if self._input:
            self._input.destroy()
        self._pipeline.locator.unsubscribe()
        self._input = None

    def _look_around(self) -> None:
        """Once a second: follow the publishers, report."""
        self._throttled.look()
        if self._input:
            self._input.follow_publishers()
            if lost := self._statistics.lost(self._input):
                self.get_logger().warning(f'{lost} (said once; see /diagnostics)', once=True)
            silence = self._statistics.silence(self._input, self._config.stall_timeout)
            if silence and not self._silent:
                self.get_logger().warning(silence)
            self._silent = bool(silence)
        self._pipeline.locator.follow_publishers()
        self._statistics.pending = self._settings.pending
        name = self.get_fully_qualified_name().lstrip('/')
        status = self._statistics.status(name, self._input, self._config.stall_timeout)
        report = DiagnosticArray(status=[status])
        report.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(report)


def _refuse(error: Exception) -> NoReturn:
    rclpy.try_shutdown()
    # The place in rcl's own sources says nothing to users.
    problem = str(error).split(', at ')[0].replace("'DOUBLE'", "'DOUBLE', such as 3.0")
    if problem.startswith('['):
        problem = f'unknown ROS arguments {problem}'
    print(f'segment_planes: {problem}', file=sys.stderr)
    sys.exit(2)


def main() -> None:
    """Run the node until a signal stops it; bad arguments end it with one line, exit code 2."""
    started = False

    def on_interrupt(number: int, stack: object) -> None:
        # Half-made objects of rclpy complain loudly of a context that is gone. A node that spins
        # is ended by rclpy's own handler, and Python's, which would raise KeyboardInterrupt
        # wherever the code is, again on every further Ctrl-C, stays out of it.
        if not started:
            os._exit(130)

    signal.signal(signal.SIGINT, on_interrupt)
    finished = True
    try:
        check_arguments(sys.argv)
        arguments = [*sys.argv, *logging_arguments()]
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (ConfigError, RuntimeError) as error:
        _refuse(error)
    try:
        node = SegmentPlanes()
    except (ConfigError, ParameterException, *_BAD_NAMES) as error:
        _refuse(error)
    executor = SingleThreadedExecutor()
    # What the core warns of, such as a lens that is left out: once each.
    warnings.showwarning = lambda message, *where: node.get_logger().warning(str(message))
    install_signal_handlers()
    started = True
    try:
        rclpy.spin(node, executor)
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
