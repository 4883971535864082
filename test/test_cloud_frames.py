"""Clouds in frames of any axes: found as in an optical frame, told in their own."""

import pickle

import numpy as np
import pytest
from clouds import scanned
from message_classes import header, make_rosbags

from rangeseg_ros import Camera, Config, RangeImage, Segmenter, SequenceSegmenter, Transform
from rangeseg_ros.core.ground.cells import GROUND
from rangeseg_ros.core.ground.points import outlines
from rangeseg_ros.core.rotations import rotation_by, rotation_matrix
from rangeseg_ros.core.sensing.clouds import completed_rays
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.solids import cast

BODY = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""x forward, y left, z up, from the optical frame (REP 103)."""
BASE = Transform(rotation_by((0, np.radians(20), 0)) @ BODY, np.array([0.3, 0, 0.8]))
"""That of a robot that the camera looks down from."""
ORIGIN = np.zeros(3)
FRAMES = {
    'body': (BODY, ORIGIN),
    'body, turned': (BODY @ rotation_by((0.1, -0.2, 0.05)), ORIGIN),
    'any': (rotation_by((1.3, -0.7, 2.1)), ORIGIN),
    'base': BASE,
    'optical, moved': (np.eye(3), np.array([0.5, -0.2, 1.0])),
    'any, moved': (rotation_by((1.3, -0.7, 2.1)), np.array([-7.0, 3, 2])),
}
CAMERA = Camera(320, 240, 290.0, 291.0, 158.5, 121.0)


def room(seed=5, camera=CAMERA, frame=0):
    """Range image of a room with noise, and its pose in the room."""
    scene = kinect_room(seed, frame + 1)
    pose = scene.poses[frame]
    depth, _ = cast(scene.solids, pose.position, camera.rays.astype(float) @ pose.rotation.T)
    depth = np.where(np.isfinite(depth), depth, 0)
    noisy = depth / (1 + depth * np.random.default_rng(seed).normal(0, 0.001, depth.shape))
    return RangeImage.from_depth(noisy, camera), Transform(pose.rotation, pose.position)


def cloud_in(frame, points):
    """Range image of points (H, W, 3) as a message has them in a frame: turn and place."""
    return RangeImage.from_points((points @ frame[0].T + frame[1]).astype(np.float32))


def stated(up):
    return dict(zip(('up_x', 'up_y', 'up_z'), map(float, up), strict=True))


@pytest.mark.parametrize('frame', FRAMES.values(), ids=FRAMES)
@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_a_room_is_segmented_as_its_depth_image(frame, method):
    image, pose = room()
    up, (turn, place) = pose.rotation[2], frame
    to_frame = np.eye(4)  # of planes
    to_frame[:3, :3], to_frame[3, :3] = turn, -place @ turn
    cloud = cloud_in(frame, image.points)
    np.testing.assert_allclose(cloud.axes, turn, atol=1e-5)
    np.testing.assert_allclose(cloud.place, place, atol=1e-5)
    np.testing.assert_allclose(cloud.points, image.points @ turn.T + place, atol=1e-4)
    height = float(pose.shift[2])
    expected, result = (
        Segmenter(Config(method=method, sensor_height=height, **stated(there))).segment(seen)
        for there, seen in ((up, image), (turn @ up, cloud))
    )
    # What rounding decides are single pixels of borders.
    assert len(expected.planes) > 6
    for plane in expected.planes:
        own = expected.labels == plane.label
        label = np.bincount(result.labels[own]).argmax()
        same = result.labels == label
        assert (own & same).sum() > 0.97 * (own | same).sum()
        (other,) = (other for other in result.planes if other.label == label)
        *normal, distance = to_frame @ [*plane.normal, plane.distance]
        assert normal @ other.normal > 1 - 1e-5
        assert other.distance == pytest.approx(distance, rel=2e-3, abs=2e-3)
        assert other.area == pytest.approx(plane.area, rel=0.05)
        covariance = to_frame @ plane.covariance @ to_frame.T
        atol = 0.1 * np.abs(covariance).max()
        np.testing.assert_allclose(other.covariance, covariance, rtol=0, atol=atol)
        np.testing.assert_allclose(turn @ plane.centroid + place, other.centroid, atol=0.02)
        np.testing.assert_allclose(turn @ plane.centre + place, other.centre, atol=0.05)
        np.testing.assert_allclose(plane.extents, other.extents, atol=0.05)
        lowest = (plane.hull @ turn.T + place).min(axis=0)
        np.testing.assert_allclose(lowest, other.hull.min(axis=0), atol=0.05)
        axis = rotation_matrix(other.orientation)[:, 0]
        assert axis @ turn[:, 0] >= -1e-6  # to the right of the image
    assert str(result.ground) == str(expected.ground)
    assert (result.terrain == expected.terrain).mean() > 0.999
    pairs = (image, expected), (cloud, result)
    here, there = (np.concatenate(outlines(seen, found.ground))[:, :3] for seen, found in pairs)
    assert len(here) == pytest.approx(len(there), rel=0.02)
    np.testing.assert_allclose((here @ turn.T + place).mean(0), there.mean(0), atol=0.02)
    cells = [OUTPUTS['grid_points'].message(make_rosbags, header(), *pair) for pair in pairs]
    here, there = (each.data.view('<f4').reshape(-1, 6)[:, :3].mean(axis=0) for each in cells)
    np.testing.assert_allclose(turn @ here + place, there, atol=0.02)
    ground = OUTPUTS['ground'].message(make_rosbags, header(), cloud, result)
    points, shown = np.frombuffer(ground.data, '<f4').reshape(-1, 4), result.terrain == GROUND
    np.testing.assert_allclose(points[:, :3], cloud.points[shown], atol=1e-6)
    np.testing.assert_array_equal(points[:, 3], result.height[shown])
    normals = expected.normals @ turn.T.astype(np.float32)
    both = np.isfinite(normals + result.normals).all(axis=2)
    assert (np.abs(normals - result.normals)[both].max(axis=1) < 0.01).mean() > 0.98


@pytest.mark.parametrize('seen', ['camera', 'scanner'])
def test_up_is_z_in_the_frame_of_a_body_where_nothing_is_stated(seen):
    rays = CAMERA.rays.astype(float) if seen == 'camera' else scanned(CAMERA)
    # In a box, 1.2 m above its floor.
    distance = (np.array((2.5, 1.2, 4.0)) / np.maximum(np.abs(rays), 1e-9)).min(axis=2)
    image = RangeImage.from_points(rays * distance[..., None])
    cloud = RangeImage.from_points((image.points @ BODY.T).astype(np.float32))
    assert (cloud.camera is None) == (image.camera is None) == (seen == 'scanner')
    results = []
    for view, up in ((image, (0, -1, 0)), (cloud, (0, 0, 1))):
        sequence = SequenceSegmenter(Config(odometry=True))
        result = sequence.segment(view, 1)
        np.testing.assert_array_equal(result.up, up)
        # The frame of the odometry: z up, x where the camera looks.
        np.testing.assert_allclose(sequence.pose.rotation @ up, (0, 0, 1), atol=1e-9)
        forward = sequence.pose.rotation @ view.axes[:, 2]
        np.testing.assert_allclose(forward, (1, 0, 0), atol=1e-6)
        results.append((sorted(plane.role for plane in result.planes), result.terrain))
    assert results[0][0] == results[1][0] and 'floor' in results[0][0]
    assert (results[0][1] == results[1][1]).mean() > 0.999


@pytest.mark.parametrize('turn', [np.eye(3), BODY, BODY @ BODY], ids=['optical', 'body', 'other'])
@pytest.mark.parametrize('around', [0.5, 2.0], ids=['sector', 'all around'])
def test_which_way_a_scanner_looks(turn, around):
    points = 3 * scanned(Camera(128, 16, 128 / np.pi / around, 37.5, 64.0, 7.5)) @ turn.T
    points[:9, :40] = np.nan
    np.testing.assert_array_equal(RangeImage.from_points(points).axes, turn)


@pytest.mark.parametrize(('width', 'height'), [(32, 24), (160, 120), (1280, 720)])
@pytest.mark.parametrize('scale', [1, 3])
def test_where_the_camera_is(width, height, scale):
    camera = Camera(width, height, 0.9 * width, 0.91 * width, width / 2 - 0.3, height / 2 + 0.4)
    points = scale * room(7, camera)[0].points
    points[np.random.default_rng(1).random(points.shape[:2]) < 0.3] = np.nan
    found = cloud_in(BASE, points).camera
    np.testing.assert_allclose(found.place, BASE.shift, atol=1e-5)
    np.testing.assert_allclose(found.axes, BASE.rotation, atol=1e-5)
    np.testing.assert_allclose(found.matrix, camera.matrix, atol=0.002)
    # Frames share a camera, and so its rays.
    assert cloud_in(BASE, 1.01 * points).camera is found
    assert pickle.loads(pickle.dumps(found)) == found


def no_cameras():
    """Clouds that no pinhole camera has taken, or that do not tell where it was."""
    rays = CAMERA.rays.astype(float)
    wall = -2 * rays / (rays @ (0.3, 0.5, -0.8))[..., None]
    v, u = np.indices(CAMERA.shape)
    # A lens that moves the corners by a fifth of a pixel.
    bent = 1 + 0.0015 * (rays[..., :2] ** 2).sum(axis=2, keepdims=True)
    points = room()[0].points
    return {
        'wall': wall,
        'parallel rays': np.stack([u * 0.01, v * 0.01, 2 + 0.3 * np.sin(u / 50)], axis=2),
        'lens': points * np.concatenate([bent, bent, np.ones_like(bent)], axis=2),
        # Between the rows and columns that tell the camera.
        'one point off': points + 0.05 * ((u == 10) & (v == 10))[..., None] * (1, 1, 0),
        'scanner': scanned(CAMERA) * np.linalg.norm(points, axis=2)[..., None],
        'mirrored': points * (-1, 1, 1),
        'axes mirrored': points[..., [1, 0, 2]],
        'row': points[:1],
        'column': points[:, :1],
        'part': np.where(v[..., None] < 120, points, np.nan),
        'nothing': np.full_like(points, np.nan),
        'one point': np.where((u == 9)[..., None], (1.0, 2, 3), np.nan),
    }


@pytest.mark.parametrize('frame', [(np.eye(3), ORIGIN), FRAMES['any'], BASE])
@pytest.mark.parametrize('name', no_cameras())
def test_no_place_is_made_up(name, frame):
    points = no_cameras()[name]
    if name == 'wall' and not frame[1].any():
        return  # seen from the origin it tells its camera
    image = cloud_in(frame, points)
    assert image.camera is None and not image.place.any()
    known, moved = np.isfinite(points).all(axis=2), points @ frame[0].T + frame[1]
    np.testing.assert_allclose(image.points[known], moved[known], rtol=1e-5)


@pytest.mark.parametrize('hole', [np.s_[20:30, 30:50], np.s_[:0]])
def test_rays_of_holes_follow_those_around(hole):
    """Of a scanner, whose columns and rows are angles, with and without a hole."""
    rays = scanned(Camera(80, 60, 100.0, 100.0, 30.0, 30.0)).astype(np.float32)
    valid = np.ones((60, 80), bool)
    valid[hole] = False
    completed, between = completed_rays(np.where(valid[..., None], rays, 0), valid)
    assert between.all()
    np.testing.assert_allclose(completed, rays, atol=1e-5)
    np.testing.assert_array_equal(completed[valid], rays[valid])


def test_a_sequence_is_followed_as_that_of_the_depth_images():
    config = Config(odometry=True, **stated((0, 0, 1)))
    seen, moved = SequenceSegmenter(config), SequenceSegmenter(config)
    told, mapped = (SequenceSegmenter(Config(fixed_frame='map')) for _ in range(2))
    for k in range(3):
        image, pose = room(frame=4 * k)
        # The same axes, so that all but the place is the same.
        level = Transform(BASE.rotation, ORIGIN)
        clouds = cloud_in(level, image.points), cloud_in(BASE, image.points)
        assert clouds[1].place.any()
        stamp = 10**9 + 4 * k * 10**9 // 30
        one, other = seen.segment(clouds[0], stamp), moved.segment(clouds[1], stamp)
        names = [[(p.id, p.surface, p.role) for p in result.planes] for result in (one, other)]
        assert names[0] == names[1] and any(name[2] == 'floor' for name in names[0])
        # Poses of the frames of the clouds: their origin is where the camera is, or before it.
        origin = moved.pose.rotation @ BASE.shift
        np.testing.assert_allclose(moved.pose.shift + origin, seen.pose.shift, atol=1e-3)
        np.testing.assert_allclose(moved.pose.rotation, seen.pose.rotation, atol=1e-3)
        speed = np.cross(moved.motion.velocity[3:], BASE.shift) + moved.motion.velocity[:3]
        np.testing.assert_allclose(speed, seen.motion.velocity[:3], atol=1e-3)
        for name, lever in (('covariance', origin), ('velocity_covariance', BASE.shift)):
            # The camera is where the origin is and goes, and what the lever adds to that.
            change = np.eye(6)
            change[:3, 3:] = np.cross(lever, np.eye(3))
            error = change @ getattr(moved.motion, name) @ change.T - getattr(seen.motion, name)
            assert np.abs(error).max() <= 1e-2 * np.abs(getattr(seen.motion, name)).max()
        poses = [pose.after(frame.inverse()) for frame in (level, BASE)]
        told.segment(clouds[0], stamp, poses[0].rotation[2], poses[0], poses[0].shift[2])
        found = mapped.segment(clouds[1], stamp, poses[1].rotation[2], poses[1], poses[1].shift[2])
        np.testing.assert_allclose(mapped.pose.shift, poses[1].shift, atol=1e-9)
        assert found.source.sensor_height == pytest.approx(pose.shift[2], abs=1e-5)
    assert len(told.map) == len(mapped.map) > 3
    for one, other in zip(told.map.planes, mapped.map.planes, strict=True):
        np.testing.assert_allclose(one.normal, other.normal, atol=1e-3)
        np.testing.assert_allclose(one.centroid, other.centroid, atol=0.02)
