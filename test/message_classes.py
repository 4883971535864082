"""Messages of rosbags and, where there is one, of rclpy."""

import numpy as np
import pytest
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
    dtype = np.dtype(
        {
            'names': list(names),
            'formats': [points.dtype.newbyteorder(order)] * 3,
            'offsets': [1, 1 + size, 1 + 2 * size],
            'itemsize': 1 + 3 * size + padding,
        }
    )
    records = np.zeros(points.shape[:2], dtype)
    for index, name in enumerate(names):
        records[name] = points[..., index]
    rows = records.view(np.uint8).reshape(len(records), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    fields = {
        'header': header(),
        'height': points.shape[0],
        'width': points.shape[1],
        'fields': [
            make_rosbags(
                'sensor_msgs/msg/PointField',
                name=name,
                offset=dtype.fields[name][1],
                datatype={4: 7, 8: 8}[size],
                count=1,
            )
            for name in names
        ],
        'is_bigendian': order == '>',
        'point_step': dtype.itemsize,
        'row_step': rows.shape[1],
        'data': rows.ravel(),
        'is_dense': False,
    }
    return make_rosbags('sensor_msgs/msg/PointCloud2', **{**fields, **changes})
