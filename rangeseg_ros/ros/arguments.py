"""The command line of the node: invalid arguments end it with one line."""

from __future__ import annotations

import itertools
import os
import sys
from dataclasses import fields
from pathlib import Path

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.utilities import remove_ros_args

from rangeseg_ros.core.options import ConfigError, unknown_parameter
from rangeseg_ros.io.params import OF_EVERY_NODE, names_of_node
from rangeseg_ros.kernel_cache import writable
from rangeseg_ros.messages.outputs import MAP_OUTPUTS, OUTPUTS
from rangeseg_ros.ros.depth_input import input_topics
from rangeseg_ros.ros.locator import IMU_TOPIC
from rangeseg_ros.ros.parameters import NodeConfig

USAGE = """\
Usage: segment_planes [--ros-args ROS_ARGUMENT...]

Find the planes in depth images: the ROS 2 node. Some ROS arguments:

  -r depth/image_rect:=TOPIC  the depth images; camera_info is taken from beside them
  -p NAME:=VALUE              a parameter
  --params-file FILE          parameters
  -r __ns:=NAMESPACE          namespace of the node

Parameters:
"""

_OVERRIDING = QoSOverridingOptions.with_default_policies()
_POLICIES = {'reliability': ReliabilityPolicy, 'history': HistoryPolicy}


def check_arguments(arguments: list[str]) -> None:
    """Refuse what is no ROS argument (ConfigError); print the help and exit when asked for it."""
    own = remove_ros_args(arguments)[1:]
    if '-h' in own or '--help' in own:
        known = ((f.name, f.default, f.metadata['description']) for f in fields(NodeConfig))
        lines = (f'  {name} (default {value!r}): {does}' for name, value, does in known)
        try:
            os.write(1, f'{USAGE}{chr(10).join(lines)}\n'.encode())
        except BrokenPipeError:
            pass  # the reader has seen enough
        except OSError as error:
            raise ConfigError(f'--help: {error.strerror}') from None
        sys.exit(0)
    if own:
        raise ConfigError(
            f'unknown argument {own[0]!r}; ROS arguments follow --ros-args, as in -p NAME:=VALUE'
        )


def check_parameters(node: Node, arguments: list[str]) -> None:
    """Refuse parameters that the node does not have, so that none is misspelt in silence.

    Those that a parameter file has for nodes of any name may be meant for others, and
    `qos_overrides` for other topics: they are warned of. ConfigError names what is refused, also a
    quality of service that does not exist.
    """
    quality = _quality_parameters(node)
    for name in sorted(quality & set(node._parameter_overrides)):
        _check_policy(name, node._parameter_overrides[name].value)
    known = {field.name for field in fields(NodeConfig)} | quality
    unknown = sorted(set(node._parameter_overrides) - known - set(OF_EVERY_NODE))
    own = {argument.partition(':=')[0].rpartition(':')[2] for argument in arguments}
    for option, file in itertools.pairwise(arguments):
        own |= names_of_node(Path(file), node.get_name()) if option == '--params-file' else set()
    topics = {name.split('.')[1] for name in quality}
    for name in unknown:
        problem = unknown_parameter(name, known | set(OF_EVERY_NODE))
        # `ros2 param dump` writes those of the topics that a node had, maybe under other names.
        foreign = name.startswith('qos_overrides.') and name.split('.')[1] not in topics
        if not foreign and own & {name, name.partition('.')[0]}:
            raise ConfigError(problem)
        problem = f'{name!r} is of another topic' if foreign else f'{problem} (of another node?)'
        node.get_logger().warning(f'{problem}, ignored')


def logging_arguments() -> list[str]:
    """What keeps rcl from writing log files where it cannot, as it would refuse to start."""
    home = os.environ.get('ROS_HOME') or Path(os.environ.get('HOME', '~'), '.ros')
    folder = os.environ.get('ROS_LOG_DIR') or Path(home, 'log')
    if writable(Path(folder).expanduser()):
        return []
    print(
        f'segment_planes: no log files: {folder} cannot be written to; set ROS_LOG_DIR',
        file=sys.stderr,
    )
    return ['--ros-args', '--disable-external-lib-logs']


def _quality_parameters(node: Node) -> set[str]:
    """Names of the parameters that decide the quality of service of what the node may open."""
    published = [f'~/{name}' for name in (*OUTPUTS, *MAP_OUTPUTS, 'odometry')]
    sources = NodeConfig.__dataclass_fields__['input'].metadata['choices']
    subscribed = {topic for source in sources for topic in input_topics(node, source)}
    ends = [f'{node.resolve_topic_name(topic)}.publisher' for topic in published]
    ends += [
        f'{topic}.subscription' for topic in (*subscribed, node.resolve_topic_name(IMU_TOPIC))
    ]
    policies = [kind.name.lower() for kind in _OVERRIDING.policy_kinds]
    return {f'qos_overrides.{end}.{policy}' for end in ends for policy in policies}


def _check_policy(name: str, value: object) -> None:
    """Refuse a policy that would end the node as soon as the topic is subscribed to."""
    policy = name.rpartition('.')[2]
    if policy in _POLICIES:
        choices = [kind.lower() for kind in _POLICIES[policy].__members__ if kind != 'UNKNOWN']
        if str(value).lower() not in choices:
            raise ConfigError(
                f'parameter {name} must be one of {", ".join(choices)}, not {value!r}'
            )
    elif policy == 'depth' and (type(value) is not int or value < 0):
        raise ConfigError(f'parameter {name} must be a number of messages, not {value!r}')
