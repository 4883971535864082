"""Results to messages and back, with the message classes of rosbags and of rclpy."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from message_classes import STORE, cdr, header, make_rosbags, needs_rclpy
from planes_of_labels import stated_plane
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, RangeImage, Segmentation, planes_from_message
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.ground.grid import GroundGrid
from rangeseg_ros.core.ground.roles import ROLES, Ramp
from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.drawing import colours
from rangeseg_ros.messages import markers
from rangeseg_ros.messages.cameras import camera_from_message, camera_info_message
from rangeseg_ros.messages.clouds import planes_message, stairs_message, thinned
from rangeseg_ros.messages.grids import grid_message, grid_points_message
from rangeseg_ros.messages.images import depth_from_message, image_message
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

ARRAY = 'visualization_msgs/msg/MarkerArray'


def places(points):
    """Array (N, 3) of geometry_msgs/Point."""
    return np.array([(point.x, point.y, point.z) for point in points]).reshape(-1, 3)


def test_label_image_reads_back_as_it_was():
    labels = np.array([[0, 1, 2], [3, 256, 65535]], np.uint16)
    message = image_message(make_rosbags, header(), labels[:, ::-1], 'mono16')
    assert (message.height, message.width, message.step) == (2, 3, 6)
    np.testing.assert_array_equal(depth_from_message(message), labels[:, ::-1])


@pytest.mark.parametrize(
    ('model', 'd'),
    [('', ()), ('equidistant', (0.1, 0.0, 0.0, 0.0)), ('rational_polynomial', (0.1,) * 8)],
)
def test_a_camera_info_names_the_lens(model, d):
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5, distortion_model=model, d=d)
    message = camera_info_message(make_rosbags, header(), camera)
    assert message.distortion_model == (model or 'plumb_bob')
    assert tuple(message.d) == (d or (0.0,) * 5)
    assert camera_from_message(message) == camera


def test_planes_read_back_as_they_were():
    message = planes_message(make_rosbags, header(), [stated_plane(1), stated_plane(2)])
    assert (message.height, message.width) == (1, 2)
    planes = planes_from_message(message)
    assert [ROLES[number] for number in planes['role']] == ['floor', 'wall']
    upper = {
        f'covariance_{"xyzd"[i]}{"xyzd"[j]}': 4 * i + j for i in range(4) for j in range(i, 4)
    }
    for column, value in {
        **{'label': [1, 2], 'id': [101, 102], 'surface': [1, 2], 'count': [1000, 2000]},
        **{'x': [0.25, 0.5], 'normal_z': -1, 'distance': 2, 'length': 2, 'width': 1.5},
        **{'confidence': np.float32(0.9), 'probability': 0.75, 'centre_y': 0.25},
        **{'orientation_x': 1, 'orientation_w': 0, **upper},
    }.items():
        np.testing.assert_array_equal(planes[column], np.broadcast_to(value, 2), column)


@pytest.mark.parametrize(
    'planes', [[], [stated_plane(1), stated_plane(2), stated_plane(3, hull=())]]
)
@pytest.mark.parametrize('name', OUTPUTS)
def test_node_and_replay_write_the_same_bytes(name, planes):
    make = needs_rclpy()
    camera = kinect_camera(32, 24)
    labels = np.minimum(np.indices(camera.shape, np.uint16)[1] // 4, len(planes))
    image = RangeImage.from_depth(np.full(camera.shape, 2000, np.uint16), camera)
    result = Segmentation(labels, planes, {}, '')
    output = OUTPUTS[name]
    live = output.message(make, header(make), image, result)
    offline = output.message(make_rosbags, header(), image, result)
    if not isinstance(offline, bytes):
        offline = bytes(STORE.serialize_cdr(offline, output.kind))
    assert cdr(live, output.kind) == offline


def test_a_thinned_cloud_has_a_point_of_every_cube_that_has_any():
    points = np.random.default_rng(0).uniform(-2, 2, (5000, 4)).astype(np.float32)
    kept = thinned(points, 0.5)
    whole, left = (np.unique(np.floor(cloud[:, :3] / 0.5), axis=0) for cloud in (points, kept))
    assert np.array_equal(left, whole) and len(kept) == len(whole)
    assert len(thinned(points, 0.01, 1000)) <= 1000 and (thinned(points, 0.0) == points).all()


TEXT = st.text(st.characters(exclude_characters='\0', codec='utf-8'), max_size=9)


@given(st.lists(st.tuples(TEXT, st.integers(0, 7), TEXT), max_size=5))
def test_bytes_of_markers_are_those_of_the_message(drawn):
    """However long texts and lists of points are, by which everything after them is aligned."""
    scale, colour, position = (0.1, 0.2, 0.3), (0.25, 0.5, 0.75, 1.0), (1.0, 2.0, 3.0)
    given = []
    for name, count, text in drawn:
        points = np.arange(3.0 * count).reshape(-1, 3)
        given.append(markers.Marker(name, count - 3, 4, scale, colour, points, text, position))
    data = markers.markers_bytes(header(), given)
    message = STORE.deserialize_cdr(data, ARRAY)
    assert bytes(STORE.serialize_cdr(message, ARRAY)) == data
    for read, marker in zip(message.markers[1:], given, strict=True):
        assert (read.ns, read.id, read.type, read.text) == (*marker[:2], 4, marker.text)
        np.testing.assert_array_equal(places(read.points), marker.points)
        assert (read.pose.position.z, read.scale.y, read.color.b) == (3.0, 0.2, 0.75)
        turn = read.pose.orientation
        assert (turn.x, turn.y, turn.z, turn.w) == (0, 0, 0, 1) and not read.frame_locked
        assert read.header == header() and read.lifetime.sec == read.lifetime.nanosec == 0


@pytest.mark.parametrize('frame', ['map', ''])
def test_cells_of_a_grid_are_where_its_axes_say(frame):
    classes = np.array([[GROUND, UNKNOWN], [OBSTACLE, DROP], [GROUND, UNKNOWN]], np.uint8)
    height = np.array([[0.3, np.nan], [0.4, np.nan], [np.nan, 0.5]], np.float32)
    others = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    turn = Rotation.from_euler('z', 90, degrees=True).as_quat()
    grid = GroundGrid(classes, height, *others, 0.5, np.array([10.0, 20, 0.2]), turn, frame)
    message = grid_message(make_rosbags, header(), grid)
    assert message.data.tolist() == [0, -1, 100, 100, 0, -1]
    assert (message.info.width, message.info.height, message.info.resolution) == (2, 3, 0.5)
    assert message.header.frame_id == (frame or 'optical')
    # Columns go along y here, and rows against x.
    points = grid_points_message(make_rosbags, header(), grid).data.view('<f4').reshape(-1, 6)
    expected = [[9.75, 20.25], [9.25, 20.25], [9.25, 20.75], [8.75, 20.25]]
    np.testing.assert_allclose(points[:, :2], expected)
    np.testing.assert_allclose(points[:, 2], [0.3, 0.4, 0.2, 0.2] if frame else [0.2] * 4)
    np.testing.assert_array_equal(points[:, [3, 5]], others[:, classes != UNKNOWN].T)
    assert points[:, 4].view('<u4').tolist() == [GROUND, OBSTACLE, DROP, GROUND]


def test_stairs_the_outline_of_the_ground_and_ramps():
    edge = np.array([[1.0, 2, 3], [3.0, 2, 5]])
    stairs = [Stairs(edge, 2.5, 4, 0.17, 0.28, way) for way in ('up', 'down')]
    message = stairs_message(make_rosbags, header(), stairs)
    assert (message.height, message.width) == (1, 2)
    points = message.data.view('<f4').reshape(2, -1)
    expected = [2, 2, 4, *edge.ravel(), 2.5, 0.17, 0.28]
    np.testing.assert_allclose(points[:, :-2], [expected] * 2, rtol=1e-6)
    assert points[:, -2:].view('<i4').tolist() == [[4, 1], [4, -1]]
    line, text, *_ = markers.of_stairs(stairs)
    assert (line.namespace, line.number, line.kind) == ('edges', 0, markers.LINE_STRIP)
    np.testing.assert_array_equal(line.points, edge)
    # Of lines, the width alone counts of their scale.
    assert (line.scale[0], line.colour) == (0.04, (1.0, 0.6, 0.0, 1.0))
    assert (text.namespace, text.text) == ('stairs', 'up 4 x 0.17 / 0.28 m')
    assert text.position == (2, 2, 4)
    (ring,) = markers.of_outline([np.eye(3)])
    np.testing.assert_array_equal(ring.points, np.eye(3)[[0, 1, 2, 0]])
    assert (ring.scale[0], ring.colour) == (0.02, (0.1, 0.9, 0.1, 1.0))
    arrow, _ = markers.of_ramps([Ramp(7, 9.0, np.ones(3), np.eye(3)[2])])
    np.testing.assert_allclose(arrow.points, [(1, 1, 1), (1, 1, 1.4)])
    assert (arrow.scale, arrow.colour) == ((0.03, 0.06, 0.1), line.colour)


def markers_of(planes):
    """Markers of planes, those of a message."""
    data = markers.markers_bytes(header(), markers.of_planes(planes))
    return STORE.deserialize_cdr(data, ARRAY).markers


def triangles_of(marker):
    """Corners (M, 3, 3) of a TRIANGLE_LIST, and its normals (M, 3), twice as long as the areas."""
    triangles = places(marker.points).reshape(-1, 3, 3)
    return triangles, np.cross(*np.diff(triangles, axis=1).swapaxes(0, 1))


def test_markers_start_anew_and_draw_hull_normal_and_id_of_every_plane():
    clear, *drawn = markers_of([stated_plane(1), stated_plane(2, hull=())])
    assert clear.action == clear.DELETEALL
    assert [(m.ns, m.id) for m in drawn] == [
        (namespace, number) for number in (101, 102) for namespace in ('hulls', 'normals', 'ids')
    ]
    hull, normal, number, no_hull = drawn[:4]
    kinds = clear.TRIANGLE_LIST, clear.ARROW, clear.TEXT_VIEW_FACING
    assert (hull.type, normal.type, number.type) == kinds
    assert np.linalg.norm(triangles_of(hull)[1], axis=1).sum() == pytest.approx(2 * 4.0)
    assert no_hull.points == []
    ends = (0.25, 0.5, 2.0), (0.25, 0.5, 2.0 - markers.ARROW_LENGTH)
    np.testing.assert_allclose(places(normal.points), ends)
    assert number.text == '101 floor'
    assert {getattr(number.color, part) for part in 'rgba'} == {1.0}
    rgb = np.array([hull.color.r, hull.color.g, hull.color.b]) * 255
    np.testing.assert_allclose(rgb, colours([101])[0])


@pytest.mark.parametrize('normal', [*np.eye(3), *-np.eye(3), (0.48, -0.6, 0.64)])
def test_a_concave_hull_with_a_hole_is_filled_and_no_more_whatever_its_direction(normal):
    """A U of three by three metres with a notch of 1 x 2 and a hole of 0.5 x 0.5."""
    axes = np.linalg.svd([normal])[2][1:]
    axes[0] *= np.linalg.det([*axes, normal])
    outline = [(0, 0), (1, 0), (1, 2), (2, 2), (2, 0), (3, 0), (3, 3), (0, 3)]
    hole = [(0.25, 1), (0.75, 1), (0.75, 1.5), (0.25, 1.5)]
    hull, ring = (ring @ axes - 2 * np.array(normal) for ring in (outline, hole))
    found = replace(stated_plane(1, hull, [ring]), normal=np.array(normal))
    triangles, normals = triangles_of(markers_of([found])[1])
    np.testing.assert_allclose(triangles @ normal, -2.0, atol=1e-12)
    # Counter-clockwise seen from the sensor, so that normals point towards it.
    doubled = normals @ normal
    assert (doubled > 0).all() and doubled.sum() / 2 == pytest.approx(9 - 2 - 0.25)
    x, y = axes @ triangles.mean(axis=1).T
    assert not ((x > 1) & (x < 2) & (y < 2)).any()
    assert not ((abs(x - 0.5) < 0.25) & (abs(y - 1.25) < 0.25)).any()
