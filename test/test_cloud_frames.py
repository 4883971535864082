"""Clouds in frames of any axes: found as in an optical frame, told in their own."""

import numpy as np
import pytest
from scanner_points import scanned

from rangeseg_ros import Camera, Config, RangeImage, Segmenter, SequenceSegmenter
from rangeseg_ros.core.mapping.sightings import may_be_in_sight
from rangeseg_ros.core.meaning.crossings import drops, outlines
from rangeseg_ros.core.rotations import rotation_by, rotation_matrix
from rangeseg_ros.core.sensing.distortion import DistortionMap
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.solids import cast

BODY = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""x forward, y left, z up, from the optical frame (REP 103)."""
FRAMES = {
    'body': BODY,
    'body, turned': BODY @ rotation_by((0.1, -0.2, 0.05)),
    'y forward': np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]) @ rotation_by((0, 0.1, 0)),
    'any': rotation_by((1.3, -0.7, 2.1)),
}
CAMERA = Camera(320, 240, 290.0, 291.0, 158.5, 121.0)


def room(seed=5):
    """Range image of a room with noise, and up in it."""
    scene = kinect_room(seed)
    pose = scene.poses[0]
    depth, _ = cast(scene.solids, pose.position, CAMERA.rays.astype(float) @ pose.rotation.T)
    depth = np.where(np.isfinite(depth), depth, 0)
    error = np.random.default_rng(seed).normal(0, 0.001, depth.shape)
    with np.errstate(divide='ignore'):
        noisy = np.where(depth > 0, 1 / (1 / depth + error), 0)
    return RangeImage.from_depth(noisy, CAMERA), pose.rotation[2]


def stated(up):
    return dict(zip(('up_x', 'up_y', 'up_z'), map(float, up), strict=True))


def overlap(labels, other, label):
    """Label of `other` that is most like a label, and the intersection over the union."""
    mask = labels == label
    found = np.bincount(other[mask]).argmax()
    return found, (mask & (other == found)).sum() / (mask | (other == found)).sum()


@pytest.mark.parametrize('turn', FRAMES.values(), ids=FRAMES)
@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_a_room_is_segmented_as_its_depth_image(turn, method):
    image, up = room()
    cloud = RangeImage.from_points((image.points @ turn.T).astype(np.float32))
    np.testing.assert_allclose(cloud.axes, turn, atol=1e-5)
    np.testing.assert_allclose(cloud.points, image.points @ turn.T, atol=1e-4)
    expected = Segmenter(Config(method=method, **stated(up))).segment(image)
    result = Segmenter(Config(method=method, **stated(turn @ up))).segment(cloud)
    # What rounding decides are single pixels of borders.
    assert len(expected.planes) > 6
    for plane in expected.planes:
        label, same = overlap(expected.labels, result.labels, plane.label)
        assert label > 0 and same > 0.97
        other = next(other for other in result.planes if other.label == label)
        assert (turn @ plane.normal) @ other.normal > 1 - 1e-5
        assert other.distance == pytest.approx(plane.distance, rel=2e-3)
        assert other.area == pytest.approx(plane.area, rel=0.05)
        np.testing.assert_allclose(turn @ plane.centroid, other.centroid, atol=0.02)
        np.testing.assert_allclose(turn @ plane.centre, other.centre, atol=0.05)
        np.testing.assert_allclose(plane.extents, other.extents, atol=0.05)
        assert np.abs(other.hull @ other.normal + other.distance).max() < 1e-5
        for low, high in zip((plane.hull @ turn.T).min(0), other.hull.min(0), strict=True):
            assert low == pytest.approx(high, abs=0.05)
        axis = rotation_matrix(other.orientation)[:, 0]
        assert axis @ turn[:, 0] >= -1e-6  # to the right of the image
    assert expected.ground.stand.surface and str(result.ground) == str(expected.ground)
    assert (result.terrain == expected.terrain).mean() > 0.999
    for find in (drops, lambda *seen: np.concatenate(outlines(*seen))):
        here, there = find(image, expected.ground)[:, :3], find(cloud, result.ground)[:, :3]
        assert len(here) == pytest.approx(len(there), rel=0.02)
        np.testing.assert_allclose((here @ turn.T).mean(0), there.mean(0), atol=0.02)
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
    # What is stated is in the frame of the message.
    leaning = Segmenter(Config(**stated((0.1, 0, 1)))).segment(cloud)
    assert leaning.up == pytest.approx(np.array((0.1, 0, 1)) / np.hypot(0.1, 1))


@pytest.mark.parametrize('turn', [np.eye(3), BODY, BODY @ BODY], ids=['optical', 'body', 'other'])
@pytest.mark.parametrize('around', [0.5, 2.0], ids=['sector', 'all around'])
def test_which_way_a_scanner_looks(turn, around):
    azimuth = np.linspace(-around, around, 128, endpoint=False) * np.pi / 2
    elevation = np.linspace(-0.2, 0.2, 16)[:, None]
    rays = np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth)
    rays = np.stack(np.broadcast_arrays(*rays[:2], rays[2] * np.cos(elevation)), axis=2)
    points = 3 * rays @ turn.T
    points[:9, :40] = np.nan
    np.testing.assert_array_equal(RangeImage.from_points(points).axes, turn)


def test_spheres_are_in_sight_where_the_camera_looks():
    image = RangeImage.from_points((CAMERA.rays * 2.0) @ BODY.T)
    ahead = np.array([(3.0, 0, 0), (3, 1.4, 0), (3, 0, 1), (0, 0, 3), (-3, 0, 0)])
    seen = may_be_in_sight(ahead, np.full(5, 0.01), image)
    assert seen.tolist() == [True, True, True, False, False]


@pytest.mark.parametrize('form', ['camera', 'scanner'])
def test_the_distortion_is_along_the_axis_that_the_cloud_looks_along(form):
    rays = CAMERA.rays if form == 'camera' else scanned(CAMERA)
    offset = np.random.default_rng(2).normal(0, 0.01, CAMERA.shape).astype(np.float32)
    distortion = DistortionMap(offset, None, 3 * offset)
    images = [RangeImage.from_points(2 * rays @ turn.T) for turn in (np.eye(3), BODY)]
    first, second = (distortion.corrected(image) for image in images)
    np.testing.assert_allclose(first.inverse, second.inverse, rtol=1e-5)
    assert np.abs(first.inverse - images[0].inverse).max() > 0.01
