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


def camera_info(make=make_rosbags, roi=None, **changes):
    camera = Camera(640, 480, 500.0, 510.0, 319.0, 239.0)
    message = camera_info_message(make, header(make), camera)
    for name, value in {'p': np.zeros(12), **changes}.items():
        setattr(message, name, value)
    for name, value in (roi or {}).items():
        setattr(message.roi, name, value)
    return message


@pytest.mark.parametrize('make', [make_rosbags, needs_rclpy])
def test_camera_honours_binning_and_region(make):
    make = make() if make is needs_rclpy else make
    roi = {'x_offset': 100, 'y_offset': 40, 'height': 200, 'width': 400}
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
    with pytest.raises(MessageError, match='rows of 3'):
        decode_image(1, 2, '16UC1', False, 3, bytes(9))
    with pytest.raises(MessageError, match='7 bytes'):
        decode_image(2, 2, '16UC1', False, 4, bytes(7))


@given(
    st.integers(0, 2**32 - 1) | st.integers(0, 5),
    st.integers(0, 2**32 - 1) | st.integers(0, 5),
    st.sampled_from(['16UC1', 'mono16', '32FC1', '8UC1', '']),
    st.booleans(),
    st.integers(0, 2**32 - 1) | st.integers(0, 24),
    st.binary(max_size=120),
)
def test_any_image_fields_decode_or_raise_the_declared_error(
    height, width, encoding, bigendian, step, data
):
    try:
        depth = decode_image(height, width, encoding, bigendian, step, data)
    except MessageError:
        return
    assert depth.shape == (height, width)


def _compressed(image, a=0.0, b=0.0):
    png = cv2.imencode('.png', image)[1].tobytes()
    return struct.pack('<iff', 0, a, b) + png


@pytest.mark.parametrize('format', ['16UC1; compressedDepth png', '16UC1; compressedDepth'])
def test_compressed_millimetres(format):
    depth = np.array([[0, 1], [500, 65535]], np.uint16)
    decoded = decode_compressed(format, _compressed(depth))
    assert decoded.dtype == np.uint16
    np.testing.assert_array_equal(decoded, depth)


def test_compressed_metres_are_inverse_depth():
    # compressed_depth_image_transport, codec.cpp: value = a / depth + b.
    a, b = 1000.0, -100.0
    value = np.array([[0, 1, 900], [400, 100, 65535]], np.uint16)
    decoded = decode_compressed('32FC1; compressedDepth png', _compressed(value, a, b))
    assert decoded.dtype == np.float32
    expected = a / (value.astype(float) - b)
    expected[0, 0] = np.nan
    np.testing.assert_allclose(decoded, expected, rtol=1e-6)


def test_quantisation_without_a_depth_is_invalid():
    value = np.array([[10, 20, 30]], np.uint16)
    decoded = decode_compressed('32FC1; compressedDepth png', _compressed(value, 1.0, 20.0))
    assert np.isnan(decoded[0, 0])  # behind the camera
    assert not np.isfinite(decoded[0, 1])
    assert decoded[0, 2] == pytest.approx(0.1)


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
    image, data = good.index(b'IHDR'), good.index(b'IDAT')
    lie = struct.pack('>I', 2**30)
    for damaged in (
        good[: image + 4] + lie + good[image + 8 :],
        good[: data - 4] + lie + good[data:],
    ):
        refused = pytest.raises(MessageError, match='no readable PNG')
        with mock.patch.object(cv2, 'imdecode') as decode, refused:
            decode_compressed('16UC1; compressedDepth png', damaged)
        assert not decode.called
    # As dense as PNG gets: one value all over.
    flat = np.full((2000, 2000), 1000, np.uint16)
    decoded = decode_compressed('16UC1; compressedDepth png', _compressed(flat))
    np.testing.assert_array_equal(decoded, flat)


@given(st.binary(max_size=60), st.integers(0, 80))
def test_any_compressed_bytes_decode_or_raise_the_declared_error(noise, cut):
    good = _compressed(np.arange(20, dtype=np.uint16).reshape(4, 5))
    for data in (noise, good[:cut], good[:cut] + noise + good[cut + len(noise) :]):
        for format in ('16UC1; compressedDepth png', '32FC1; compressedDepth png'):
            try:
                depth = decode_compressed(format, data)
            except MessageError:
                continue
            assert depth.ndim == 2
