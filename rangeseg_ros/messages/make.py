"""Constructors of messages, with the classes of rclpy or of rosbags.

Messages are read by their fields and made by a `Make`, so that the node and an offline replay
publish and write the same bytes, and this package imports without ROS.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

# Makes a message from the name of its type and all its fields, e.g.
# make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=1.0); octets are given as uint8 arrays, and a
# single one as a number.
Make = Callable[..., Any]


def make_rclpy(kind: str, **fields: Any) -> Any:
    """Make a message of the sourced ROS installation, or of the wheels."""
    cls, octets = _class_and_octets(kind)
    for name, many in octets:
        if many:
            # rclpy takes an array of bytes as it is, and a numpy array octet by octet.
            data, fields[name] = fields[name], array('B')
            fields[name].frombytes(np.ascontiguousarray(data))
        else:
            fields[name] = bytes([fields[name]])
    return cls(**fields)


@cache
def _class_and_octets(kind: str) -> tuple[type, list[tuple[str, bool]]]:
    """Class of rclpy, and its fields that are octets: name, and whether they are many."""
    cls: Any = message_class(kind)
    types = cls.get_fields_and_field_types().items()
    return cls, [(n, t != 'octet') for n, t in types if t in ('octet', 'sequence<uint8>')]


@cache
def message_class(kind: str) -> type:
    """Class of rclpy for e.g. 'sensor_msgs/msg/Image'; ImportError when it is not installed."""
    package, _, name = kind.split('/')
    found: type = getattr(import_module(f'{package}.msg'), name)
    return found
