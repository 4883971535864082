"""Messages to depth images, cameras and clouds: exact small cases, and malformed ones."""

import struct
from contextlib import suppress
from types import SimpleNamespace
from unittest import mock

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from message_classes import STORE, cloud, header, make_rosbags, needs_rclpy

from rangeseg_ros import Camera, RangeImage, planes_from_message
from rangeseg_ros.messages.cameras import camera_from_message, camera_info_message
from rangeseg_ros.messages.clouds import _POINT_FIELD_TYPES, points_from_message
from rangeseg_ros.messages.images import depth_from_message
from rangeseg_ros.messages.make import MessageError


def camera_info(make=make_rosbags, **changes):
    camera = Camera(640, 480, 500.0, 510.0, 319.0, 239.0)
    message = camera_info_message(make, header(make), camera)
    for name, value in {'p': np.zeros(12), **changes}.items():
        setattr(message, name, value)
    return message


@pytest.mark.parametrize('make', [make_rosbags, needs_rclpy])
def test_camera_honours_binning_and_region(make):
    make = make() if make is needs_rclpy else make
    message = camera_info(make, binning_x=2, binning_y=2)
    message.roi.x_offset, message.roi.y_offset = 100, 40
    message.roi.width, message.roi.height = 400, 200
    # Column 319 of the full image is 219 of the region, between its columns 109 and 110.
    centre = (219 + 0.5) / 2 - 0.5, (199 + 0.5) / 2 - 0.5
    assert camera_from_message(message) == Camera(200, 100, 250, 255, *centre)


def test_camera_is_the_same_object_while_nothing_changes():
    assert camera_from_message(camera_info()) is camera_from_message(camera_info())
    p = np.array([400.0, 0, 300, 0, 0, 400, 200] + [0] * 5)
    assert camera_from_message(camera_info(p=p)) == Camera(640, 480, 400, 400, 300, 200)


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
        ({'height': 1, 'width': 2}, 'not organised'),
    ],
)
def test_damaged_cloud_is_refused_with_the_reason(changes, problem):
    message = cloud(np.ones((3, 4, 3), np.float32), **changes)
    with pytest.raises(MessageError, match=problem):
        points_from_message(message)


LARGE, BYTE = st.integers(0, 2**32 - 1), st.integers(0, 255)
SIZES = dict.fromkeys(('height', 'width', 'point_step', 'row_step'), LARGE)
DATA = st.binary(max_size=200).map(lambda data: np.frombuffer(data, np.uint8))
NAME = st.sampled_from(['x', 'y', 'z', '', 'w'])
FIELD = st.fixed_dictionaries({'name': NAME, 'offset': LARGE, 'count': LARGE, 'datatype': BYTE})


@given(st.fixed_dictionaries({**SIZES, 'data': DATA}), st.lists(FIELD, max_size=5))
def test_any_bytes_are_a_cloud_or_a_named_error(changes, layout):
    changes['fields'] = [make_rosbags('sensor_msgs/msg/PointField', **field) for field in layout]
    for read in (points_from_message, planes_from_message):
        with suppress(MessageError):
            read(cloud(np.ones((1, 1, 3)), **changes))


def decode_image(*fields):
    names = 'height', 'width', 'encoding', 'is_bigendian', 'step', 'data'
    return depth_from_message(SimpleNamespace(**dict(zip(names, fields, strict=True))))


def decode_compressed(format, data):
    return depth_from_message(SimpleNamespace(format=format, data=data))


@pytest.mark.parametrize('bigendian', [False, True])
@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize('encoding', ['16UC1', 'mono16', '32FC1'])
def test_every_encoding_byte_order_and_padding(encoding, bigendian, padding):
    expected = np.array([[0, 1, 258], [65535, 7, 4000]])
    if encoding == '32FC1':
        expected = expected / 1000
        expected[0, 0] = np.nan
    native = expected.astype(np.float32 if encoding == '32FC1' else np.uint16)
    stored = native.astype(native.dtype.newbyteorder('>' if bigendian else '<'))
    data = b''.join(row.tobytes() + b'\xaa' * padding for row in stored)
    step = 3 * native.itemsize + padding
    for length in (len(data), len(data) - padding):  # drivers omit the last row's padding
        depth = decode_image(2, 3, encoding, bigendian, step, data[:length])
        assert depth.dtype == native.dtype
        np.testing.assert_array_equal(depth, native)


def test_image_errors_name_what_is_wrong():
    with pytest.raises(MessageError, match="'rgb8'"):
        decode_image(1, 1, 'rgb8', False, 3, bytes(3))
    with pytest.raises(MessageError, match='empty'):
        decode_image(0, 1, '16UC1', False, 2, b'')
    with pytest.raises(MessageError, match='empty'):
        decode_image(1, 0, '16UC1', False, 2, b'')
    with pytest.raises(MessageError, match='rows of 3'):
        decode_image(1, 2, '16UC1', False, 3, bytes(9))
    with pytest.raises(MessageError, match='7 bytes'):
        decode_image(2, 2, '16UC1', False, 4, bytes(7))


def _compressed(image, a=0.0, b=0.0):
    return struct.pack('<iff', 0, a, b) + cv2.imencode('.png', image)[1].tobytes()


@pytest.mark.parametrize('format', ['16UC1; compressedDepth png', '16UC1; compressedDepth'])
def test_compressed_millimetres(format):
    depth = np.array([[0, 1], [500, 65535]], np.uint16)
    decoded = decode_compressed(format, _compressed(depth))
    assert decoded.dtype == np.uint16
    np.testing.assert_array_equal(decoded, depth)


@pytest.mark.parametrize(('a', 'b'), [(1000.0, -100.0), (1.0, 20.0)])
def test_compressed_metres_are_inverse_depth(a, b):
    # compressed_depth_image_transport, codec.cpp: value = a / depth + b.
    value = np.array([[0, 1, 10], [20, 30, 65535]], np.uint16)
    decoded = decode_compressed('32FC1; compressedDepth png', _compressed(value, a, b))
    assert decoded.dtype == np.float32
    with np.errstate(divide='ignore'):
        expected = a / (value.astype(float) - b)
    expected[(value == 0) | (expected < 0)] = np.nan  # invalid, or behind the camera
    np.testing.assert_allclose(decoded, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ('format', 'data', 'message'),
    [
        ('16UC1; compressedDepth rvl', bytes(40), 'rvl'),
        ('rgb8; jpeg compressed bgr8', bytes(40), 'rgb8'),
        ('16UC1; compressedDepth png', bytes(12), '12 bytes'),
        ('16UC1; compressedDepth png', bytes(40), 'no readable PNG'),
        ('16UC1; compressedDepth png', _compressed(np.zeros((2, 2), np.uint8)), 'uint8'),
        ('16UC1; compressedDepth png', _compressed(np.zeros((2, 2, 3), np.uint16)), '16-bit'),
    ],
)
def test_compressed_errors_name_what_is_wrong(format, data, message):
    with pytest.raises(MessageError, match=message):
        decode_compressed(format, data)


def test_lengths_that_promise_more_than_can_follow_are_refused_before_memory_is_taken():
    good = _compressed(np.zeros((20, 20), np.uint16))
    lie = struct.pack('>I', 2**30)
    for at in (good.index(b'IHDR') + 4, good.index(b'IDAT') - 4):
        damaged = good[:at] + lie + good[at + 4 :]
        refused = pytest.raises(MessageError, match='no readable PNG')
        with mock.patch.object(cv2, 'imdecode') as decode, refused:
            decode_compressed('16UC1; compressedDepth png', damaged)
        assert not decode.called
