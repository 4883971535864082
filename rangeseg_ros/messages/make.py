"""Arrays <-> ROS messages, whoever implements the message classes: rclpy or rosbags.

Messages are read by their fields and made by a `Make`, so that the node and an offline replay
publish and write the same bytes, and this module imports without ROS.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import cache, lru_cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.messages.images import decode_compressed, decode_image

# Makes a message from the name of its type and all its fields, e.g.
# make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=1.0); octets are given as uint8 arrays.
Make = Callable[..., Any]


def make_rclpy(kind: str, **fields: Any) -> Any:
    """Make a message of the sourced ROS installation, or of the wheels."""
    for name, value in fields.items():
        # rclpy takes an array of bytes as it is, and a numpy array octet by octet.
        if isinstance(value, np.ndarray) and value.dtype == np.uint8:
            fields[name] = array('B', value.tobytes())
    return message_class(kind)(**fields)


@cache
def message_class(kind: str) -> type:
    """Class of rclpy for e.g. 'sensor_msgs/msg/Image'; ImportError when it is not installed."""
    package, _, name = kind.split('/')
    found: type = getattr(import_module(f'{package}.msg'), name)
    return found


def depth_from_message(message: Any) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Depth image (H, W) of a sensor_msgs/Image, or a CompressedImage of compressedDepth.

    Raises
    ------
    EncodingError
        The message holds no depth image, or a damaged one.
    """
    if hasattr(message, 'format'):
        return decode_compressed(message.format, message.data)
    return decode_image(
        message.height,
        message.width,
        message.encoding,
        bool(message.is_bigendian),
        message.step,
        message.data,
    )


def camera_from_message(info: Any) -> Camera:
    """Camera of a sensor_msgs/CameraInfo; the same object, with its rays, while nothing changes.

    Raises
    ------
    CameraError
        Intrinsics that cannot belong to a pinhole camera.
    """
    roi = info.roi
    return _camera(
        info.width,
        info.height,
        tuple(float(value) for value in info.k),
        tuple(float(value) for value in info.p),
        (info.binning_x, info.binning_y),
        (roi.x_offset, roi.y_offset, roi.width, roi.height),
    )


@lru_cache(maxsize=4)
def _camera(*fields: Any) -> Camera:
    return Camera.from_matrices(*fields)


def image_message(make: Make, header: Any, pixels: NDArray, encoding: str) -> Any:
    """sensor_msgs/Image of an array (H, W) or (H, W, channels)."""
    rows = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder('<'))
    return make(
        'sensor_msgs/msg/Image',
        header=header,
        height=rows.shape[0],
        width=rows.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.strides[0],
        data=rows.reshape(-1).view(np.uint8),
    )
