"""How messages are made, whoever implements their classes: rclpy or rosbags.

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
# single one as np.uint8.
Make = Callable[..., Any]


def make_rclpy(kind: str, **fields: Any) -> Any:
    """Make a message of the sourced ROS installation, or of the wheels."""
    for name, value in fields.items():
        # rclpy takes an array of bytes as it is, and a numpy array octet by octet.
        if isinstance(value, np.ndarray) and value.dtype == np.uint8:
            fields[name] = array('B')
            fields[name].frombytes(np.ascontiguousarray(value))
        elif isinstance(value, np.uint8):
            fields[name] = bytes([value])
    return message_class(kind)(**fields)


@cache
def message_class(kind: str) -> type:
    """Class of rclpy for e.g. 'sensor_msgs/msg/Image'; ImportError when it is not installed."""
    package, _, name = kind.split('/')
    found: type = getattr(import_module(f'{package}.msg'), name)
    return found
