"""Arrays <-> messages, with the message classes of rosbags and, where there is one, of rclpy."""

from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from rangeseg_ros import CameraError, RangeImage, Segmentation, planes_from_message
from rangeseg_ros.core.roles import ROLES
from rangeseg_ros.drawing import colours
from rangeseg_ros.ros.clouds import CloudError, planes_message, points_from_message
from rangeseg_ros.ros.markers import ARROW_LENGTH, markers_message
from rangeseg_ros.ros.messages import (
    camera_from_message,
    depth_from_message,
    image_message,
    make_rclpy,
)
from rangeseg_ros.ros.outputs import OUTPUTS
from rangeseg_ros.simulation.kinect import kinect_camera

STORE = get_typestore(Stores.ROS2_JAZZY)


def make_rosbags(kind, **fields):
    return STORE.types[kind](**fields)


def needs_rclpy():
    pytest.importorskip('rclpy')
    return make_rclpy


def header(make=make_rosbags):
    stamp = make('builtin_interfaces/msg/Time', sec=12, nanosec=345)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id='optical')


SQUARE = ((-1, -1, 2), (-1, 1, 2), (1, 1, 2), (1, -1, 2))


def plane(label, hull=SQUARE, holes=()):
    """A region of the plane z = 2 m with the attributes of a Plane."""
    return SimpleNamespace(
        label=label,
        id=label + 100,
        surface=label,
        role=('other', 'floor', 'wall')[label % 3],
        normal=np.array([0.0, 0.0, -1.0]),
        distance=2.0,
        covariance=np.arange(16.0).reshape(4, 4),
        centroid=np.array([0.25 * label, 0.5, 2.0]),
        count=1000 * label,
        rms=0.003,
        confidence=0.9,
        area=4.0,
        extents=np.array([2.0, 1.5]),
        centre=np.array([0.0, 0.25, 2.0]),
        orientation=np.array([1.0, 0.0, 0.0, 0.0]),
        hull=np.array(hull, float).reshape(-1, 3),
        holes=[np.array(hole, float) for hole in holes],
    )


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


def test_label_image_reads_back_as_it_was():
    labels = np.array([[0, 1, 2], [3, 256, 65535]], np.uint16)
    message = image_message(make_rosbags, header(), labels[:, ::-1], 'mono16')
    assert (message.height, message.width, message.step) == (2, 3, 6)
    np.testing.assert_array_equal(depth_from_message(message), labels[:, ::-1])


def test_planes_read_back_as_they_were():
    message = planes_message(make_rosbags, header(), [plane(1), plane(2)])
    assert (message.height, message.width) == (1, 2)
    planes = planes_from_message(message)
    np.testing.assert_array_equal(planes['label'], [1, 2])
    np.testing.assert_array_equal(planes['id'], [101, 102])
    np.testing.assert_array_equal(planes['count'], [1000, 2000])
    np.testing.assert_array_equal(planes['x'], [0.25, 0.5])
    np.testing.assert_array_equal(planes['normal_z'], [-1, -1])
    np.testing.assert_array_equal(planes['distance'], [2, 2])
    covariance = {
        f'covariance_{row}{column}': 4 * i + j
        for i, row in enumerate('xyzd')
        for j, column in enumerate('xyzd')
        if i <= j
    }
    np.testing.assert_array_equal(planes['surface'], [1, 2])
    assert [ROLES[number] for number in planes['role']] == ['floor', 'wall']
    np.testing.assert_array_equal(planes['confidence'], np.float32([0.9, 0.9]))
    for column, value in {
        'length': 2,
        'width': 1.5,
        'centre_y': 0.25,
        'orientation_x': 1,
        'orientation_w': 0,
        **covariance,
    }.items():
        np.testing.assert_array_equal(planes[column], [value, value])


@pytest.mark.parametrize('make', [make_rosbags, needs_rclpy])
def test_no_planes_are_an_empty_cloud(make):
    make = make() if make is needs_rclpy else make
    planes = planes_from_message(planes_message(make, header(make), []))
    assert planes.shape == (0,) and 'distance' in planes.dtype.names


@pytest.mark.parametrize('planes', [[], [plane(1), plane(2), plane(3, hull=())]])
@pytest.mark.parametrize('name', OUTPUTS)
def test_node_and_replay_write_the_same_bytes(name, planes):
    make = needs_rclpy()
    from rclpy.serialization import serialize_message

    camera = kinect_camera(32, 24)
    labels = np.zeros(camera.shape, np.uint16)
    for number in range(len(planes)):
        labels[:, 4 * number :] = number + 1
    image = RangeImage.from_depth(np.full(camera.shape, 2000, np.uint16), camera)
    result = Segmentation(labels, planes, {}, '', lambda: 0.0)
    output = OUTPUTS[name]
    live = output.message(make, header(make), image, result)
    offline = output.message(make_rosbags, header(), image, result)
    sent = serialize_message(live)
    written = bytes(STORE.serialize_cdr(offline, output.kind))
    # Fast CDR leaves the bytes between aligned fields undefined: write them again.
    sent_again = bytes(STORE.serialize_cdr(STORE.deserialize_cdr(sent, output.kind), output.kind))
    assert len(sent) == len(written) and sent_again == written


def corners_of(marker):
    """Triangles (M, 3, 3) of a TRIANGLE_LIST."""
    return np.array([(p.x, p.y, p.z) for p in marker.points]).reshape(-1, 3, 3)


def area_of(triangles):
    first, second, third = np.moveaxis(triangles, 1, 0)
    return np.linalg.norm(np.cross(second - first, third - first), axis=1).sum() / 2


def test_markers_start_anew_and_draw_hull_normal_and_id_of_every_plane():
    message = markers_message(make_rosbags, header(), [plane(1), plane(2, hull=())])
    clear, *drawn = message.markers
    assert clear.action == clear.DELETEALL
    assert [(m.ns, m.id) for m in drawn] == [
        (namespace, number) for number in (101, 102) for namespace in ('hulls', 'normals', 'ids')
    ]
    hull, normal, number, no_hull = drawn[:4]
    assert (hull.type, normal.type, number.type) == (
        hull.TRIANGLE_LIST,
        hull.ARROW,
        hull.TEXT_VIEW_FACING,
    )
    assert area_of(corners_of(hull)) == pytest.approx(4.0)
    assert no_hull.points == []
    start, tip = ((p.x, p.y, p.z) for p in normal.points)
    np.testing.assert_allclose(np.subtract(tip, start), (0, 0, -ARROW_LENGTH), atol=1e-12)
    assert number.text == '101 floor'
    rgb = np.array([hull.color.r, hull.color.g, hull.color.b]) * 255
    np.testing.assert_allclose(rgb, colours([101])[0])


def test_concave_hull_with_a_hole_is_filled_and_no_more():
    """A U of three by three metres with a notch of 1 x 2 and a hole of 0.5 x 0.5."""
    outline = [(0, 0), (0, 3), (3, 3), (3, 0), (2, 0), (2, 2), (1, 2), (1, 0)]
    hole = [(0.25, 1), (0.75, 1), (0.75, 1.5), (0.25, 1.5)]
    rings = [[(x, y, 2.0) for x, y in ring] for ring in (outline, hole)]
    message = markers_message(make_rosbags, header(), [plane(1, rings[0], rings[1:])])
    triangles = corners_of(message.markers[1])
    assert area_of(triangles) == pytest.approx(9 - 2 - 0.25)
    np.testing.assert_allclose(triangles[..., 2], 2.0, atol=1e-12)
    # Counter-clockwise seen from the sensor, so that normals point towards it.
    first, second, third = np.moveaxis(triangles, 1, 0)
    assert (np.cross(second - first, third - first)[:, 2] < 0).all()
    centres = triangles.mean(axis=1)
    notch = (centres[:, 0] > 1) & (centres[:, 0] < 2) & (centres[:, 1] < 2)
    inside = (abs(centres[:, 0] - 0.5) < 0.25) & (abs(centres[:, 1] - 1.25) < 0.25)
    assert not (notch | inside).any()


@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('sign', [-1, 1])
def test_triangles_of_planes_of_any_direction_face_the_sensor(axis, sign):
    tilt = Rotation.from_euler('xyz', [20, -15, 30], degrees=True)
    normal = tilt.apply(sign * np.eye(3)[axis])
    frame = np.linalg.svd(normal[None])[2][1:]
    frame *= np.linalg.det([*frame, normal])
    hull = np.array([(0, 0), (2, 0), (1, 0.5), (2, 2), (0, 2)]) @ frame - 2 * normal
    found = plane(1, hull)
    found.normal = normal
    triangles = corners_of(markers_message(make_rosbags, header(), [found]).markers[1])
    first, second, third = np.moveaxis(triangles, 1, 0)
    doubled = np.cross(second - first, third - first) @ normal
    assert (doubled > 0).all() and doubled.sum() / 2 == pytest.approx(3)


def test_a_hull_that_crosses_itself_still_makes_whole_triangles():
    bow_tie = [(0, 0, 2), (1, 1, 2), (0, 1, 2), (1, 0, 2), (2, 3, 2)]
    hull = markers_message(make_rosbags, header(), [plane(1, bow_tie)]).markers[1]
    assert len(hull.points) % 3 == 0


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


@pytest.mark.parametrize('focal', [0.0, -1.0, np.nan, np.inf])
def test_impossible_focal_length_is_refused(focal):
    with pytest.raises(CameraError, match=r'f[xy]'):
        camera_from_message(camera_info(k=np.array([focal, 0, 319, 0, focal, 239, 0, 0, 1])))


@pytest.mark.parametrize('order', '<>')
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_organised_cloud_of_any_layout(order, dtype):
    points = np.arange(36, dtype=dtype).reshape(3, 4, 3)
    points[1, 2] = np.nan
    read = points_from_message(cloud(points, order, padding=5))
    np.testing.assert_array_equal(read, points)
    assert read.dtype == dtype and RangeImage.from_points(read).valid.sum() == 11


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
    with pytest.raises(CloudError, match=problem):
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
        with suppress(CloudError):
            read(message)
