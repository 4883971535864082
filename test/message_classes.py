"""Messages of rosbags and, where there is one, of rclpy."""

from functools import partial

import numpy as np
import pytest
from numpy.lib.recfunctions import unstructured_to_structured
from rosbags.typesys import Stores, get_typestore

from rangeseg_ros.messages.make import make_rclpy

STORE = get_typestore(Stores.ROS2_JAZZY)


def make_rosbags(kind, **fields):
    return STORE.types[kind](**fields)


def needs_rclpy():
    pytest.importorskip('rclpy')
    return make_rclpy


def cdr(message, kind):
    """Bytes of a message of rclpy; between aligned fields, where Fast CDR leaves any, zeros."""
    from rclpy.serialization import serialize_message

    data = message if isinstance(message, bytes) else serialize_message(message)
    return bytes(STORE.serialize_cdr(STORE.deserialize_cdr(data, kind), kind))


def header(make=make_rosbags):
    stamp = make('builtin_interfaces/msg/Time', sec=12, nanosec=345)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id='optical')


def cloud(points, order='<', padding=0, names='xyz', **changes):
    """PointCloud2 of points (H, W, 3), each with a byte before and padding after it."""
    size = points.dtype.itemsize
    offsets = [1, 1 + size, 1 + 2 * size]
    dtype = np.dtype(
        {
            'names': list(names),
            'formats': [points.dtype.newbyteorder(order)] * 3,
            'offsets': offsets,
            'itemsize': 1 + 3 * size + padding,
        }
    )
    rows = unstructured_to_structured(points, dtype).view(np.uint8).reshape(len(points), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    kind = {'datatype': {4: 7, 8: 8}[size], 'count': 1}
    columns = zip(names, offsets, strict=True)
    field = partial(make_rosbags, 'sensor_msgs/msg/PointField', **kind)
    fields = {
        'header': header(),
        'height': points.shape[0],
        'width': points.shape[1],
        'fields': [field(name=name, offset=offset) for name, offset in columns],
        'is_bigendian': order == '>',
        'point_step': dtype.itemsize,
        'row_step': rows.shape[1],
        'data': rows.ravel(),
        'is_dense': False,
    }
    return make_rosbags('sensor_msgs/msg/PointCloud2', **{**fields, **changes})
