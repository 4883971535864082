"""Messages of rosbags and, where there is one, of rclpy."""

from functools import partial

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from rangeseg_ros.messages.make import header_of, make_rclpy

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
    return header_of(make, 12_000_000_345, 'optical')


def cloud(points, order='<', padding=0, names='xyz', **changes):
    """PointCloud2 of points (H, W, 3), each with a byte before and padding after it."""
    size = points.dtype.itemsize
    step, kind = 1 + 3 * size + padding, {'datatype': {4: 7, 8: 8}[size], 'count': 1}
    rows = np.ascontiguousarray(points, points.dtype.newbyteorder(order)).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, 0), (1, padding))).reshape(len(points), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    field = partial(make_rosbags, 'sensor_msgs/msg/PointField', **kind)
    fields = {
        'header': header(),
        'height': points.shape[0],
        'width': points.shape[1],
        'fields': [field(name=name, offset=1 + k * size) for k, name in enumerate(names)],
        'is_bigendian': order == '>',
        'point_step': step,
        'row_step': rows.shape[1],
        'data': rows.ravel(),
        'is_dense': False,
    }
    return make_rosbags('sensor_msgs/msg/PointCloud2', **{**fields, **changes})
