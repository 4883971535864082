"""ROS parameters are the configuration: declared from it, checked by it, and nothing besides."""

import os
from dataclasses import fields
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

import rclpy
import ros_bench  # noqa: F401 - gives DDS a domain of its own
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.parameter import Parameter

from rangeseg_ros import Config, ConfigError
from rangeseg_ros.io.params import read_config, read_params
from rangeseg_ros.ros.parameters import NodeConfig, bind

PARAMS = Path(__file__).parents[1] / 'params' / 'segment_planes.yaml'


@pytest.fixture(scope='module')
def context():
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


@pytest.fixture
def node_with(context):
    nodes = []

    def start(**overrides):
        parameters = [Parameter(name, value=value) for name, value in overrides.items()]
        nodes.append(Node('segment_planes', context=context, parameter_overrides=parameters))
        return nodes[-1]

    yield start
    for node in nodes:
        node.destroy_node()


def test_every_option_is_a_parameter_with_its_default_range_and_description(node_with):
    node = node_with()
    assert bind(node, lambda config: None) == NodeConfig()
    for option in fields(Config):
        assert node.get_parameter(option.name).value == option.default
        descriptor = node.describe_parameter(option.name)
        assert descriptor.description == option.metadata['description']
        low, high = option.metadata['low'], option.metadata['high']
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert [(r.from_value, r.to_value) for r in ranges] == (
            [] if low is None else [(low, high)]
        )
        assert all(
            choice in descriptor.additional_constraints for choice in option.metadata['choices']
        )


def test_start_with_other_values(node_with):
    node = node_with(smoothness=7.5, exact=True, method='normals')
    expected = NodeConfig(smoothness=7.5, exact=True, method='normals')
    assert bind(node, lambda config: None) == expected


@pytest.mark.parametrize('bad', [{'method': 'magic'}, {'direction_count': 306}])
def test_bad_start_values_are_named(node_with, bad):
    with pytest.raises(ConfigError, match=next(iter(bad))):
        bind(node_with(**bad), lambda config: None)


def test_start_value_of_another_type_is_named(node_with):
    with pytest.raises(InvalidParameterTypeException, match='smoothness'):
        bind(node_with(smoothness=True), lambda config: None)


def test_changes_apply_all_or_none(node_with):
    applied = []
    node = node_with()
    bind(node, applied.append)

    def change(**values):
        return node.set_parameters_atomically([Parameter(n, value=v) for n, v in values.items()])

    assert change(smoothness=10.0, min_pixels=2).successful
    assert applied == [NodeConfig(smoothness=10.0, min_pixels=2)]
    for values, reason in [
        ({'min_pixels': 3, 'method': 'magic'}, 'method'),
        ({'min_pixels': 3, 'smoothness': -1.0}, 'smoothness'),
        ({'min_pixels': 3, 'smoothness': float('nan')}, 'smoothness'),
        ({'min_pixels': 3, 'directions': 'regular'}, 'direction_count'),
        ({'min_pixels': 3, 'smoothness': 'much'}, 'DOUBLE'),
    ]:
        result = change(**values)
        assert not result.successful and reason in result.reason
        assert node.get_parameter('min_pixels').value == 2
    # Values that only together make sense go together.
    assert change(directions='regular', direction_count=225).successful
    assert applied[1:] == [
        NodeConfig(smoothness=10.0, min_pixels=2, directions='regular', direction_count=225)
    ]


def test_parameters_of_others_are_none_of_ours(node_with):
    applied = []
    node = node_with()
    bind(node, applied.append)
    node.declare_parameter('qos_of_another', 1)
    assert node.set_parameters([Parameter('qos_of_another', value=2)])[0].successful
    assert not applied


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
