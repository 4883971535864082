"""Parts of the node over rclpy: parameters, settings in use, events, what /diagnostics says."""

import os
import time
from dataclasses import fields
from pathlib import Path
from threading import Event, Timer
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_bench import values_of  # and a domain of its own for DDS
from std_msgs.msg import Empty

from rangeseg_ros import Config
from rangeseg_ros.compilation.preparation import FIRST
from rangeseg_ros.core.sensing.verdict import Verdict
from rangeseg_ros.io.params import read_config, read_params
from rangeseg_ros.ros import settings, throttled_events
from rangeseg_ros.ros.counting import Losses, Window
from rangeseg_ros.ros.depth_input import PROFILE_VARIABLE, SEGMENT_SIZE, DepthInput
from rangeseg_ros.ros.diagnostics import FrameStatistics, FrameTimes
from rangeseg_ros.ros.parameters import NodeConfig, bind
from rangeseg_ros.ros.settings import Settings
from rangeseg_ros.ros.throttled_events import ThrottledCallbackGroup

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PARAMS = Path(__file__).parents[1] / 'params' / 'segment_planes.yaml'


@pytest.fixture(scope='module')
def context():
    with rclpy.Context() as context:
        yield context


@pytest.fixture
def node(context):
    node = Node('segment_planes', context=context)
    yield node
    node.destroy_node()


def test_every_option_is_a_parameter_with_its_default_range_and_description(node):
    assert bind(node, lambda config: None) == NodeConfig()
    for option in fields(Config):
        assert node.get_parameter(option.name).value == option.default
        descriptor = node.describe_parameter(option.name)
        assert descriptor.description == option.metadata['description']
        low, high = option.metadata['low'], option.metadata['high']
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        expected = [] if low is None else [(low, high)]
        assert [(found.from_value, found.to_value) for found in ranges] == expected
        constraints = descriptor.additional_constraints
        assert all(choice in constraints for choice in option.metadata['choices'])


def test_changes_apply_all_or_none(node):
    applied = []
    bind(node, applied.append)

    def change(**values):
        return node.set_parameters_atomically([Parameter(n, value=v) for n, v in values.items()])

    assert change(smoothness=10.0, min_pixels=2).successful
    assert applied == [NodeConfig(smoothness=10.0, min_pixels=2)]
    for values, reason in [
        ({'min_pixels': 3, 'method': 'magic'}, 'method'),
        ({'min_pixels': 3, 'smoothness': -1.0}, 'smoothness'),
        ({'min_pixels': 3, 'smoothness': float('nan')}, 'smoothness'),
        ({'min_pixels': 3, 'direction_count': 225}, 'direction_count'),
        ({'min_pixels': 3, 'smoothness': 'much'}, 'DOUBLE'),
        ({'target_rate': 5.0, 'method': 'normals'}, 'target_rate is for method planes'),
    ]:
        result = change(**values)
        assert not result.successful and reason in result.reason
        assert node.get_parameter('min_pixels').value == 2
    # Values that only together make sense go together.
    assert change(work_budget=0.5).successful and not change(method='normals').successful
    assert change(method='normals', work_budget=1.0).successful
    assert applied[2:] == [NodeConfig(smoothness=10.0, min_pixels=2, method='normals')]
    # Parameters of others are none of ours.
    node.declare_parameter('qos_of_another', 1)
    assert change(qos_of_another=2).successful and len(applied) == 3


def test_shipped_parameter_file_holds_the_defaults(context):
    assert read_config(PARAMS) == Config()
    arguments = ['--ros-args', '--params-file', os.fspath(PARAMS)]
    node = Node('segment_planes', context=context, cli_args=arguments)
    assert bind(node, lambda config: None) == NodeConfig()
    node.destroy_node()


def test_every_parameter_file_undoes_any_other():
    """`ros2 param load` of one after another leaves nothing of the first."""
    names = {path.name: set(read_params(path)) for path in PARAMS.parent.glob('*.yaml')}
    assert len(names) > 4
    for name, found in names.items():
        assert found == names['segment_planes.yaml'], name


@pytest.fixture
def compilation(monkeypatch):
    """Takes the place of the compiler: of more than the first outputs once it is released."""

    def prepare(config, kinds, report, outputs):
        if outputs != FIRST:
            known.release.wait()
        known.came.append(outputs)

    known = SimpleNamespace(came=[], release=Event())
    monkeypatch.setattr(settings, 'prepare', prepare)
    return known


def settings_of(config=NodeConfig(), changed=lambda: None):  # noqa: B008
    return Settings(config, lambda progress: None, changed)


def test_the_first_frames_wait_for_labels_and_other_outputs_for_their_kernels(compilation):
    first, other = NodeConfig(), NodeConfig(min_pixels=500)
    used = settings_of(first)
    assert used.in_use() is first
    used.want(other)  # needs no other kernels
    assert used.in_use() is other and not used.pending
    used._use(first)  # a thread that has not heard of the other one yet
    assert used.in_use() is other
    assert used.ready_for('labels') and compilation.came == [FIRST]
    Timer(0.2, compilation.release.set).start()
    assert used.ready_for('terrain') and set(compilation.came[1]) > set(FIRST)
    used.close()


def test_what_is_asked_for_last_is_in_use_in_the_end(monkeypatch):
    """Also when what was asked for before it is compiled later."""
    first, normals, last = NodeConfig(), NodeConfig(method='normals'), NodeConfig(min_pixels=500)
    begun, release, changed, served = Event(), Event(), Event(), []

    def prepare(config, kinds, report, outputs):
        if config.exact:
            served.append(used.in_use())
        elif config.method == 'normals':
            begun.set()
            release.wait()

    monkeypatch.setattr(settings, 'prepare', prepare)
    used = settings_of(first, changed.set)
    assert used.in_use() is first and used.ready_for('terrain')
    used.want(normals)
    begun.wait()
    assert used.in_use() is first and used.pending
    used.want(last)
    assert used.in_use() is last and not used.pending
    release.set()
    exact = NodeConfig(method='normals', exact=True)
    used.want(exact)
    while used.pending:  # `changed` when the normals' kernels are there as well
        changed.wait(0.1)
    assert served == [last] and used.in_use() is exact and not used.pending
    used.want(normals)  # whose kernels are there by now
    assert used.in_use() is normals
    used.close()


def test_what_a_robot_stops_for_comes_first_once_its_kernels_are_there(compilation):
    used, ended = settings_of(), settings_of()
    assert used.in_use() and ended.in_use()
    # Whoever waits is let go at the end.
    ended.close()
    assert ended.in_use() is None and not ended.ready_for('terrain')
    names = ['labels', 'normals', 'drops']
    assert used.ready_first(names) == names
    compilation.release.set()
    assert used.ready_for('drops')
    assert used.ready_first(['drops', 'nothing', 'labels']) == ['drops', 'labels', 'nothing']
    used.close()


@pytest.mark.ros
def test_events_wait_while_messages_come(context):
    came, group = [], ThrottledCallbackGroup(interval=1e9)
    node = rclpy.create_node('node', context=context)
    events = PublisherEventCallbacks(matched=lambda event: came.append(event.current_count))
    callbacks = {'event_callbacks': events, 'callback_group': group}
    publisher = node.create_publisher(Empty, 'topic', 5, **callbacks)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin_until(condition):
        while not condition():
            executor.spin_once(timeout_sec=0.01)

    node.create_subscription(Empty, 'topic', lambda message: None, 5)
    spin_until(lambda: came == [1])
    group.message_came()
    assert group.can_execute(publisher.event_handlers[0])  # the first has nothing before it
    group.message_came()
    node.create_subscription(Empty, 'topic', lambda message: None, 5)
    spin_until(lambda: publisher.get_subscription_count() == 2)
    for _ in range(20):
        executor.spin_once(timeout_sec=0.01)
    assert came == [1]
    group.look()
    spin_until(lambda: came == [1, 2])


def test_the_interval_is_kept(monkeypatch):
    group = ThrottledCallbackGroup(interval=0.1)
    event, looked = Event(), []
    group.add_entity(event)
    for now in (5.0, 5.05, 5.09, 5.1, 5.15, 5.25):
        monkeypatch.setattr(throttled_events.time, 'monotonic', lambda now=now: now)
        group.message_came()
        looked.append(group.can_execute(event))
    assert looked == [True, False, False, True, False, True]


@pytest.mark.ros
def test_what_may_help_against_losses_follows_the_size_of_the_messages(monkeypatch):
    source = DepthInput.__new__(DepthInput)
    monkeypatch.delenv(PROFILE_VARIABLE, raising=False)
    hints = 'if they are over', '', 'messages over'
    for size, hint in zip((0, SEGMENT_SIZE, SEGMENT_SIZE + 1), hints, strict=True):
        source._largest = size
        assert source.loss_hint().partition(' 512 KiB')[0] == hint
    monkeypatch.setenv(PROFILE_VARIABLE, 'profile.xml')
    assert 'publisher needs it' in source.loss_hint()


def status(**found):
    statistics = FrameStatistics()
    for name, value in found.items():
        setattr(statistics, name, value)
    source = SimpleNamespace(last_arrival=time.monotonic(), problem='', pairing='', topic='/depth')
    source.loss_hint = lambda: 'a larger buffer'
    return statistics.status('segment_planes', source, 3600.0)


def result(verdict=Verdict(), **worked_out):  # noqa: B008
    known = {'planes': [1, 2], 'reason': '', 'sensor': '', 'work_budget': 1.0, 'tilt': ''}
    return SimpleNamespace(verdict=verdict, **{**known, **worked_out})


@pytest.mark.parametrize(
    ('found', 'level', 'message'),
    [
        ({}, OK, '2 planes at 0.0 Hz'),
        ({'planes': [], 'reason': 'too far'}, WARN, 'no planes: too far'),
        ({'verdict': Verdict(('millimetres in floats',), ('What it is.',))}, ERROR, 'What it is.'),
        ({'verdict': Verdict(('range instead of z',), ('What it is.',))}, ERROR, 'What it is.'),
        ({'verdict': Verdict(('enlarged x 4',), ('What it is.',))}, WARN, 'What it is.'),
    ],
)
def test_what_is_found_is_told_and_what_is_wrong(found, level, message):
    """A wrong unit is an error, an enlarged image a warning."""
    worked_out = {'ground': '1.20 m below', 'stairs': ['up 4 x 0.17 / 0.28 m', 'down 3']}
    told = status(found=result(**found, **worked_out))
    assert (told.level, told.message) == (level, message)
    values = values_of(told)
    assert values['input'] == (message if 'verdict' in found else 'trusted')
    assert values['ground'] == '1.20 m below'
    assert values['stairs'] == 'up 4 x 0.17 / 0.28 m, down 3'


@pytest.mark.parametrize('transport', [-1.5, 3.6e6, 3.6e6 + 1, -3.7e6])
def test_the_latency_is_unknown_where_stamps_are_not_of_the_clock_of_the_node(transport):
    """They are more than `stall_timeout` apart from it, which is an hour."""
    told = values_of(status(times=FrameTimes(transport, 2.0, 3.0, 4.0, 5.0, {'refining': 3.5})))
    values = {name: value for name, value in told.items() if 'ms' in name}
    parts = {'waiting': 2, 'conversion': 3, 'compute': 4, 'compute: refining': 3.5}
    expected = {'latency since arrival': 14, **parts, 'publication': 5}
    if abs(transport) <= 3.6e6:
        expected |= {'latency': transport + 14, 'transport': transport}
    else:
        assert values.pop('latency (ms)').startswith('unknown')
    assert values == {f'{name} (ms)': f'{time:.2f}' for name, time in expected.items()}


def test_lost_messages_are_a_warning_with_their_share_and_what_helps():
    received, losses = Window(), Losses()
    received.add(3)
    losses.lost.add(1)
    found = status(received=received, losses=losses)
    assert (found.level, found.message) == (WARN, '25% lost on /depth: a larger buffer')
