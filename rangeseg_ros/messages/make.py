"""Constructors of messages, with the classes of rclpy or of rosbags.

Messages are read by their fields and made by a `Make`, so that the node and an offline replay
publish and write the same bytes, and this package imports without ROS.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Makes a message from the name of its type and all its fields, e.g.
# make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=1.0); octets are given as uint8 arrays, and a
# single one as a number.
Make = Callable[..., Any]


CAMERA_INFO, IMAGE = 'sensor_msgs/msg/CameraInfo', 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE, CLOUD = 'sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/PointCloud2'
GRID, ODOMETRY = 'nav_msgs/msg/OccupancyGrid', 'nav_msgs/msg/Odometry'
MARKERS = 'visualization_msgs/msg/MarkerArray'
STATUS = 'diagnostic_msgs/msg/DiagnosticArray'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'


class MessageError(ValueError):
    """A message that is damaged, or not what is asked for."""


def make_rclpy(kind: str, **fields: Any) -> Any:
    """Make a message of the sourced ROS installation, or of the wheels."""
    cls, octets = _class_and_octets(kind)
    for name, code in octets:
        if code:
            # rclpy takes a numpy array octet by octet, and copies an array that it does not check.
            data, fields[name], fields['check_fields'] = fields[name], array(code), True
            fields[name].frombytes(np.ascontiguousarray(data))
        else:
            fields[name] = bytes([fields[name]])
    return cls(**fields)


# Types of fields that are octets, and the codes of their arrays.
_OCTETS = {'octet': '', 'sequence<uint8>': 'B', 'sequence<int8>': 'b'}


@cache
def _class_and_octets(kind: str) -> tuple[type, list[tuple[str, str]]]:
    """Class of rclpy, and its fields that are octets with the codes of their arrays."""
    cls: Any = message_class(kind)
    types = cls.get_fields_and_field_types().items()
    return cls, [(name, _OCTETS[kind]) for name, kind in types if kind in _OCTETS]


@cache
def message_class(kind: str) -> type:
    """Class of rclpy for e.g. 'sensor_msgs/msg/Image'; ImportError when it is not installed."""
    package, _, name = kind.split('/')
    found: type = getattr(import_module(f'{package}.msg'), name)
    return found


def header_of(make: Make, stamp: Any, frame: str) -> Any:
    """std_msgs/Header of a stamp, a message or nanoseconds."""
    if isinstance(stamp, int):
        sec, nanosec = divmod(stamp, 10**9)
        stamp = make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id=frame)


def nanoseconds(stamp: Any) -> int:
    """Of a builtin_interfaces/Time; rclpy's own Time refuses negative ones.

    ROS 1 calls the parts secs and nsecs; rosbags gives both the names of ROS 2.
    """
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def elements(message: Any, kind: np.dtype, step: int, what: str) -> NDArray:
    """Elements (H, W) of an image or a cloud, native byte order; rows begin every `step` bytes.

    The last row need not be padded. MessageError where its data are too few.
    """
    height, width, data = message.height, message.width, np.frombuffer(message.data, np.uint8)
    row = width * kind.itemsize
    if step < row or data.size < step * (height - 1) + row:
        raise MessageError(
            f'{data.size} bytes of data are too few for {width}x{height} {what} of '
            f'{kind.itemsize} bytes in rows of {step} bytes'
        )
    found: NDArray = np.ndarray((height, width), kind, data, 0, (step, kind.itemsize))
    return found.astype(kind.newbyteorder('='), copy=False)


def vector(make: Make, kind: str, numbers: Iterable[float]) -> Any:
    """Message of geometry_msgs with the fields x, y, z or x, y, z, w."""
    return make(
        f'geometry_msgs/msg/{kind}', **dict(zip('xyzw', map(float, numbers), strict=False))
    )


def pose_of(make: Make, place: Iterable[float], turn: Iterable[float]) -> Any:
    """geometry_msgs/Pose of a point and a quaternion."""
    point, quaternion = vector(make, 'Point', place), vector(make, 'Quaternion', turn)
    return make('geometry_msgs/msg/Pose', position=point, orientation=quaternion)
