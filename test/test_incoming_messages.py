"""Cameras and clouds from messages, with the message classes of rosbags and of rclpy."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from message_classes import STORE, cloud, header, make_rosbags, needs_rclpy

from rangeseg_ros import RangeImage, planes_from_message
from rangeseg_ros.messages.cameras import camera_from_message
from rangeseg_ros.messages.clouds import _POINT_FIELD_TYPES, points_from_message
from rangeseg_ros.messages.make import MessageError


def camera_info(make=make_rosbags, **changes):
    fields = {
        'header': header(make),
        'height': 480,
        'width': 640,
        'distortion_model': 'plumb_bob',
        'd': [0.0] * 5,
        'k': np.array([500.0, 0, 319, 0, 510, 239, 0, 0, 1]),
        'r': np.eye(3).ravel(),
        'p': np.zeros(12),
        'binning_x': 0,
        'binning_y': 0,
        'roi': region(make),
    }
    return make('sensor_msgs/msg/CameraInfo', **{**fields, **changes})


def region(make=make_rosbags, x_offset=0, y_offset=0, height=0, width=0):
    return make(
        'sensor_msgs/msg/RegionOfInterest',
        x_offset=x_offset,
        y_offset=y_offset,
        height=height,
        width=width,
        do_rectify=False,
    )


@pytest.mark.parametrize('make', [make_rosbags, needs_rclpy])
def test_camera_honours_binning_and_region(make):
    make = make() if make is needs_rclpy else make
    roi = region(make, x_offset=100, y_offset=40, height=200, width=400)
    camera = camera_from_message(camera_info(make, binning_x=2, binning_y=2, roi=roi))
    assert camera.shape == (100, 200)
    assert (camera.fx, camera.fy) == (250, 255)
    # Column 319 of the full image is 219 of the region, between its columns 109 and 110.
    assert (camera.cx, camera.cy) == ((219 + 0.5) / 2 - 0.5, (199 + 0.5) / 2 - 0.5)


def test_camera_is_the_same_object_while_nothing_changes():
    first = camera_from_message(camera_info())
    assert camera_from_message(camera_info()) is first
    changed = camera_from_message(
        camera_info(p=np.array([400.0, 0, 300, 0, 0, 400, 200] + [0] * 5))
    )
    assert (changed.fx, changed.fy) == (400, 400)


@pytest.mark.parametrize('order', '<>')
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_organised_cloud_of_any_layout(order, dtype):
    points = np.arange(36, dtype=dtype).reshape(3, 4, 3)
    points[1, 2] = np.nan
    read = points_from_message(cloud(points, order, padding=5))
    np.testing.assert_array_equal(read, points)
    assert read.dtype == dtype and RangeImage.from_points(read).valid.sum() == 11


def test_numbers_of_fields_are_those_of_the_message():
    kind = STORE.types['sensor_msgs/msg/PointField']
    names = {'i': 'INT', 'u': 'UINT', 'f': 'FLOAT'}
    for number, name in _POINT_FIELD_TYPES.items():
        assert getattr(kind, f'{names[name[0]]}{8 * int(name[1])}') == number


@pytest.mark.parametrize(
    'changes, problem',
    [
        ({'names': 'xyw'}, 'fields x, y, z'),
        ({'point_step': 4}, 'contradictory fields'),
        ({'row_step': 3}, 'too few'),
        ({'height': 4}, 'too few'),
        ({'data': np.zeros(0, np.uint8)}, 'too few'),
        ({'height': 1, 'width': 3}, 'not organised'),
    ],
)
def test_damaged_cloud_is_refused_with_the_reason(changes, problem):
    names = changes.pop('names', 'xyz')
    message = cloud(np.ones((3, 4, 3), np.float32), names=names, **changes)
    with pytest.raises(MessageError, match=problem):
        points_from_message(message)


@given(
    data=st.binary(max_size=200),
    height=st.integers(0, 2**32 - 1),
    width=st.integers(0, 2**32 - 1),
    point_step=st.integers(0, 2**32 - 1),
    row_step=st.integers(0, 2**32 - 1),
    layout=st.lists(
        st.tuples(
            st.sampled_from(['x', 'y', 'z', '', 'w']),
            st.integers(0, 2**32 - 1),
            st.integers(0, 255),
            st.integers(0, 2**32 - 1),
        ),
        max_size=5,
    ),
)
def test_any_bytes_are_a_cloud_or_a_named_error(data, height, width, point_step, row_step, layout):
    fields = [
        make_rosbags(
            'sensor_msgs/msg/PointField', name=name, offset=offset, datatype=kind, count=count
        )
        for name, offset, kind, count in layout
    ]
    message = make_rosbags(
        'sensor_msgs/msg/PointCloud2',
        header=header(),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=point_step,
        row_step=row_step,
        data=np.frombuffer(data, np.uint8),
        is_dense=False,
    )
    for read in (points_from_message, planes_from_message):
        with suppress(MessageError):
            read(message)
