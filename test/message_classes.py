"""Messages of rosbags and, where there is one, of rclpy."""

import pytest
from rosbags.typesys import Stores, get_typestore

from rangeseg_ros.messages.make import make_rclpy

STORE = get_typestore(Stores.ROS2_JAZZY)


def make_rosbags(kind, **fields):
    return STORE.types[kind](**fields)


def needs_rclpy():
    pytest.importorskip('rclpy')
    return make_rclpy


def header(make=make_rosbags):
    stamp = make('builtin_interfaces/msg/Time', sec=12, nanosec=345)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id='optical')
