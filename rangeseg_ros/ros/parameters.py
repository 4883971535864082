"""ROS parameters of the node, declared from the fields of its configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, dataclass, fields, replace
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.options import ConfigError, option
from rangeseg_ros.io.corrections import check_corrections


@dataclass(frozen=True)
class NodeConfig(Config):
    """The parameters of the segmenter and those that only the node has."""

    input: str = option(
        'image',
        'depth images (image), images of compressed_depth_image_transport (compressed_depth) or '
        'organised clouds (points)',
        choices=('image', 'compressed_depth', 'points'),
    )
    raw: bool = option(
        False,
        'depth images are raw: lens distortion D and K of camera_info count, not P; so they do '
        'anyway where the topic is named image_raw or P is missing',
    )
    use_imu: bool = option(
        False,
        'take up from the accelerometer on the topic imu, in the frame of the images or one that '
        'tf knows, with gravity_frame or alone, instead of up_x, up_y, up_z',
    )
    managed: bool = option(
        False,
        'wait for a lifecycle manager: publish and subscribe only while active; read at the start',
    )
    target_rate: float = option(
        0.0,
        'method planes: frames per second to be held by doing less of the work, down from '
        'work_budget; 0 = off. ~/status has the share of the work that each frame was made with',
        low=0.0,
        high=1000.0,
    )
    stall_timeout: float = option(
        2.0,
        'seconds without a depth image while somebody listens, or with images and without an '
        'output, that /diagnostics calls an error',
        low=0.1,
        high=3600.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target_rate > 0 and self.method != 'planes':
            raise ConfigError('parameter target_rate is for method planes')


def bind(node: Node, apply: Callable[[NodeConfig], None]) -> NodeConfig:
    """Declare the parameters of `node`: the configuration to start with.

    `apply` gets the new configuration after every change. ConfigError or ParameterException: a bad
    value among the parameters that the node was started with.
    """
    declared: list[Any] = [(f.name, f.default, _descriptor(f)) for f in fields(NodeConfig)]
    given = node.declare_parameters('', declared)
    config = NodeConfig(**{parameter.name: parameter.value for parameter in given})
    check_corrections(config)

    def changed(parameters: list[Parameter]) -> NodeConfig:
        known = NodeConfig.__dataclass_fields__
        return replace(config, **{p.name: p.value for p in parameters if p.name in known})

    def check(parameters: list[Parameter]) -> SetParametersResult:
        try:
            check_corrections(changed(parameters))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def keep(parameters: list[Parameter]) -> None:
        nonlocal config
        if (new := changed(parameters)) != config:
            config = new
            apply(new)

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(keep)
    return config


def _descriptor(declared: Field[Any]) -> ParameterDescriptor:
    """Description and range of a `Config` field."""
    metadata = declared.metadata
    # Read at the start alone.
    fixed = declared.name == 'managed'
    descriptor = ParameterDescriptor(description=metadata['description'], read_only=fixed)
    if metadata['choices']:
        descriptor.additional_constraints = f'one of {", ".join(metadata["choices"])}'
    low, high = metadata['low'], metadata['high']
    if isinstance(declared.default, float) and low is not None:
        bounds = FloatingPointRange(from_value=float(low), to_value=float(high))
        descriptor.floating_point_range = [bounds]
    elif low is not None:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return descriptor
