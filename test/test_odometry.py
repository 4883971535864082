"""Odometry from planes: true motions, what planes leave open, no jumps, files and messages."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from message_classes import header, make_rosbags
from planes_of_labels import fit_planes
from recordings import Recording
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, Config, ConfigError, RangeImage, Transform
from rangeseg_ros.batch.replay import Replay
from rangeseg_ros.core.mapping.edges import JumpPoints
from rangeseg_ros.core.mapping.observations import PoseNoise, observations, views
from rangeseg_ros.core.mapping.odometry import _POSES, PlaneOdometry
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.messages.motion import odometry_message
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import Pose, Scene, kinect_room, walk
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera
from rangeseg_ros.simulation.solids import box, half_space

CAMERA = kinect_camera(160, 120)
CONFIG = Config()
SENSOR = SensorModel.from_config(CONFIG)
IDENTITY = Transform.identity()
STEP = 4
"""Frames of a walk, at 30 Hz, from one that is seen to the next."""


def planes_of(scene, k, seed):
    """What a camera sees of true faces: planes whose ids are their numbers, and their views."""
    view = simulate(scene, Kinect(seed), CAMERA, frame=k, seed=seed)
    image = RangeImage.from_depth(view.depth, CAMERA)
    faces = {plane.label: plane.face for plane in view.planes}
    planes = fit_planes(view.labels, image, SENSOR)
    found = [replace(p, id=faces[p.label] + 1) for p in planes if p.count > 100]
    return found, views(view.labels, found, CONFIG.distortion_length)


def still(seed):
    """The same of the first frame of a room."""
    return planes_of(kinect_room(seed), 0, seed)


def followed(scene, frames, seed=0):
    """Motions of the camera, and its true poses in the frame of the odometry."""
    odometry, motions = PlaneOdometry(), []
    truths = [Transform(pose.rotation, pose.position) for pose in scene.poses]
    for k in frames:
        seen = *planes_of(scene, k, seed), 10**9 + k * 10**9 // 30
        motions.append(odometry.add(*seen, truths[0].rotation[2]))
    return motions, [motions[0].pose.after(truths[0].inverse()).after(truths[k]) for k in frames]


def errors_of(motion, truth):
    """Shift (3,) and turn (3,) that a pose is off."""
    turn = Rotation.from_matrix(truth.rotation @ motion.pose.rotation.T).as_rotvec()
    return np.concatenate([truth.shift - motion.pose.shift, turn])


def test_walks_are_followed_and_the_error_is_known():
    values, errors = [], []
    for seed in range(4):
        motions, truths = followed(kinect_room(seed, 33, walk), range(0, 33, STEP), seed)
        error = errors_of(motions[-1], truths[-1])
        values.append(error @ np.linalg.solve(motions[-1].covariance, error) / 6)
        errors.append(np.linalg.norm(error.reshape(2, 3), axis=1))
        moved = truths[-1].shift - truths[-2].shift
        speed = truths[-1].rotation @ motions[-1].velocity[:3]
        assert speed == pytest.approx(moved / (STEP / 30), abs=0.15)
    assert (np.median(errors, axis=0) < (0.02, np.radians(0.8))).all()
    assert 0.1 < np.mean(values) < 2.0


@pytest.mark.parametrize('walls', [1, 2])
def test_what_planes_do_not_hold_is_known_less_and_less(walls):
    solids = [half_space((-1, 0, 0), (2.5, 0, 0)), half_space((0, -1, 0), (0, 1.0, 0))][:walls]
    # Sliding up, which is along both walls.
    poses = [Pose.looking((0, 0, 1 + 0.004 * k), 10, 0, 0) for k in range(60)]
    motions, truths = followed(Scene(tuple(solids), tuple(poses)), range(60))
    wide = [np.sqrt(np.diag(motion.covariance)) for motion in motions]
    forward, left, up, roll, pitch, yaw = wide[-1]
    assert up > 0.3 and up > 1.3 * wide[30][2] > 1.6 * wide[15][2]
    # Of the axes of the odometry, x is ten degrees off the first wall's normal.
    normal = truths[0].rotation @ poses[0].rotation.T @ np.array([1.0, 0, 0])
    along = np.sqrt(normal @ motions[-1].covariance[:3, :3] @ normal)
    about = np.sqrt(normal @ motions[-1].covariance[3:, 3:] @ normal)
    assert along < 0.03 and pitch < np.radians(20)
    if walls == 1:
        assert left > 0.3 and about > np.radians(20) and yaw < np.radians(10)
    else:
        assert max(forward, left) < 0.05 and max(roll, pitch, yaw) < np.radians(2)
    error = errors_of(motions[-1], truths[-1])
    assert error @ np.linalg.solve(motions[-1].covariance, error) < 22  # 0.999 of six


def test_the_ends_of_a_box_tell_the_motion_along_two_walls():
    """Sliding up along both, past a box on one of them; without its edges nobody knows."""
    box_ = box((0.4, 0.5, 0.3), np.eye(3), (2.3, 0.2, 1.0))
    walls = half_space((-1, 0, 0), (2.5, 0, 0)), half_space((0, -1, 0), (0, 1.0, 0))
    poses = [Pose.looking((0, 0, 0.9 + 0.01 * k), 10, 0, 0) for k in range(13)]
    scene, up = Scene((*walls, box_), tuple(poses)), poses[0].rotation[2]
    alone, aided = PlaneOdometry(), PlaneOdometry()
    for k in range(0, 13, 2):
        planes, view = planes_of(scene, k, 5)
        image = RangeImage.from_depth(simulate(scene, Kinect(0), CAMERA, frame=k).depth, CAMERA)
        result = Segmenter().segment(image)
        edges = JumpPoints.of(image, result.jumps, result.cells)
        held = [n for n, plane in enumerate(planes) if abs(plane.normal @ up) < 0.5]
        shown = [planes[n] for n in held], view[held], 10**9 + k * 10**9 // 30, up
        motions = alone.add(*shown), aided.add(*shown, edges=edges)
    off = [abs(motion.pose.shift[2] - 0.12) for motion in motions]
    height = [motion.covariance[2, 2] ** 0.5 for motion in motions]
    assert off[0] < 3 * height[0] and off[1] < 3 * height[1]
    assert height[0] > 0.05 > 0.02 > max(off[1], height[1])


def outline_of(turn, shift, random):
    """Points on edges of three directions, as cameras with errors see them."""
    corner = np.array([[0.3, -0.2, 2.0], [-0.5, 0.3, 2.5], [0.2, 0.4, 3.0]])
    along = np.linspace(0, 0.6, 200)[:, None]
    lines = [corner[k] + along * np.roll([1.0, 0.3, 0.1], k) for k in range(3)]
    points = (np.concatenate(lines) - shift) @ turn
    return JumpPoints(points + random.normal(0, 0.002, points.shape), 0.004)


def told_of_motion(last, now):
    """Error of the pose (6,) of points, and its covariance; both poses are taken to be 0."""
    prior = np.diag(np.repeat([0.03, 0.05, 1e-9, 1e-9], 3) ** 2)
    design, told = now.motion(last, IDENTITY, IDENTITY, prior)
    covariance = np.linalg.inv(design.T @ design + np.linalg.inv(prior))
    return (covariance @ design.T @ told)[:6], covariance[:6, :6]


def test_points_at_jump_edges_tell_a_known_motion_as_well_as_is_said():
    """Those of edges that are hidden in the next image, an eighth, count less than their share."""
    random, aside, told = np.random.default_rng(0), np.array([0.03, 0.03, 0.0]), []
    for _ in range(40):
        true = random.normal(0, np.repeat([0.02, 0.03], 3))
        last, now = (outline_of(*pose, random) for pose in (IDENTITY, IDENTITY.by(true)))
        hidden = last._replace(points=np.concatenate([last.points, last.points[::8] + aside]))
        (found, covariance), (off, _) = (told_of_motion(points, now) for points in (last, hidden))
        error = found - true
        sizes = np.linalg.norm([error[3:], (off - found)[3:]], axis=1)
        told.append([error @ np.linalg.solve(covariance, error) / 6, *sizes])
    # Independent points, which these are, tell more than is said of points along an edge.
    assert 0.005 < np.mean(told, axis=0)[0] < 1
    assert (np.median(told, axis=0)[1:] < (0.01, np.linalg.norm(aside) / 9)).all()


def test_new_planes_err_as_the_pose_from_which_they_are_seen():
    """What corrects the pose moves them along."""
    draw, odometry, (planes, view) = np.random.default_rng(0), PlaneOdometry(), still(1)
    seen = observations(planes, view, IDENTITY, PoseNoise(0.0, 0.0))
    pose = Transform(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([1.0, -2, 0.5]))
    root = draw.normal(size=(18, 18))
    odometry._covariance = prior = root @ root.T
    odometry._append(pose, seen, np.arange(len(planes)))
    effect = odometry._covariance[18:, :18] @ np.linalg.inv(prior)
    error = 1e-5 * draw.normal(size=18)
    corrected = odometry._planes.without((effect @ error).reshape(-1, 3))
    moved = seen.planes.moved(pose.by(error[:6]))
    np.testing.assert_allclose(corrected.equations, moved.equations, atol=1e-8)


def test_edges_are_taken_in_as_a_filter_does():
    """Against the information form: inverse covariances add up."""
    draw, odometry = np.random.default_rng(3), PlaneOdometry()
    root, told, values = draw.normal(size=(18, 18)), draw.normal(size=(5, 12)), draw.normal(size=5)
    prior = root @ root.T / 18
    odometry._covariance = prior.copy()
    edges = SimpleNamespace(motion=lambda last, before, pose, own: (told, values))
    odometry._align(IDENTITY, edges)
    design = np.zeros((5, 18))
    design[:, _POSES] = told
    expected = np.linalg.inv(np.linalg.inv(prior) + design.T @ design)
    np.testing.assert_allclose(odometry._covariance, expected, atol=1e-9)
    np.testing.assert_allclose(odometry._velocity, (expected @ design.T @ values)[6:12])


def test_a_straight_edge_tells_nothing_along_itself_and_few_points_nothing():
    points = np.array([0.0, 0.0, 2.0]) + np.linspace(-0.5, 0.5, 100)[:, None] * [1.0, 0, 0]
    edge, prior, pose = JumpPoints(points, 0.004), np.eye(12) * 0.01, IDENTITY
    design, _ = edge.motion(edge, pose, pose, prior)
    across = np.abs(design[:, 3:6]).max(axis=0)
    assert across[1] > 10 and across[0] < 1e-6 * across[1] > across[2]
    # What both poses err by alike is not seen.
    turned = pose.by(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]))
    design, _ = edge.motion(edge, turned, turned, prior)
    np.testing.assert_allclose(design[:, :6], -design[:, 6:], atol=1e-6)
    # Of poses that are known, what is farther off than points err has no counterpart.
    for off, told in ((0.002, True), (0.02, False)):
        beside = JumpPoints(points + np.array([0, off, 0]), 0.004)
        assert bool(edge.motion(beside, pose, pose, 0 * prior)[0].size) == told
    few, none = JumpPoints(points[:15], 0.004), JumpPoints.of(None, None, None)
    for last, now in ((edge, few), (none, edge)):
        assert not now.motion(last, pose, pose, prior)[0].size


def test_jump_points_are_on_the_near_side():
    inverse = np.full((40, 60), 0.5, np.float32)
    inverse[10:30, 20:40] = 1.0
    inverse[:, 50:] = 0  # not measured
    camera = Camera(60, 40, 50.0, 50.0, 29.5, 19.5)
    image = replace(RangeImage.from_depth(1 / np.maximum(inverse, 0.1), camera), inverse=inverse)
    jumps = tuple(np.abs(np.diff(inverse, axis=axis)) > 0.2 for axis in (1, 0))
    found = JumpPoints.of(image, jumps, None)
    assert len(found.points) == 2 * (20 + 20) - 4
    np.testing.assert_allclose(found.points[:, 2], 1.0)
    rows = found.points[:, 1] * 50 + 19.5
    assert rows.min() == pytest.approx(10) and rows.max() == pytest.approx(29)
    assert found.width == pytest.approx(1 / 50, rel=0.1)


def test_other_planes_under_known_ids_do_not_make_it_jump():
    (planes, view), odometry, pose = still(1), PlaneOdometry(), None
    for k in range(24):
        # All exchange their ids, come under new ones, or are not there.
        ids = np.roll([p.id for p in planes], -(k == 8)) + 100 * (k == 12)
        named = [replace(p, id=int(i)) for p, i in zip(planes, ids, strict=True)]
        shown = 0 if 16 <= k < 20 else len(named)
        motion = odometry.add(named[:shown], view[:shown], 10**9 + k * 10**9 // 30, (0, -1, 0))
        if k == 20:
            assert motion.held == 0
        if pose:
            off = pose.inverse().after(motion.pose)
            assert np.linalg.norm(off.shift) < 0.01
            assert Rotation.from_matrix(off.rotation).magnitude() < np.radians(1)
        pose = motion.pose
    assert np.linalg.eigvalsh(motion.covariance).min() > 0


def test_z_is_up_and_x_forward_whatever_the_camera_sees():
    for up in ((0, -1, 0), (0, -0.8, -0.6), (0.1, 0.7, 0.2), (0, 0, 1), (0, 0, -1)):
        turn = PlaneOdometry().add([], np.zeros((0, 4)), 0, up).pose.rotation
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(turn @ up / np.linalg.norm(up), (0, 0, 1), atol=1e-12)
        assert turn[0, 2] >= -1e-12 and abs(turn[1, 2]) < 1e-12
    assert turn[0].tolist() == [0, -1, 0]  # straight down: the top of the image


def test_stamps_that_do_not_tell_and_gaps_are_no_trouble():
    seen, odometry = still(2), PlaneOdometry()
    for stamp in (0, 0, 10**9, 10**9, 5 * 10**8, 10**12, 10**18, -5):
        motion = odometry.add(*seen, stamp, (0, -1, 0))
        assert np.linalg.norm(motion.pose.shift) < 0.01 and np.isfinite(motion.covariance).all()
        assert np.linalg.eigvalsh(motion.covariance).min() > -1e-12


def test_the_message_has_pose_and_twist_in_their_frames():
    motion = PlaneOdometry().add(*still(2), 10**9, (0, -1, 0))
    message = odometry_message(make_rosbags, header(), motion)
    assert message.header.frame_id == 'odom' and message.header.stamp == header().stamp
    assert message.child_frame_id == header().frame_id
    turn = message.pose.pose.orientation
    found = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    np.testing.assert_allclose(found, motion.pose.rotation, atol=1e-12)
    covariance = message.twist.covariance.reshape(6, 6)
    # Metres per second come first.
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), np.repeat([0.9, np.pi / 3], 3))


def test_the_map_is_in_the_frame_of_the_odometry_without_tf(tmp_path):
    recording, config = Recording(), Config(odometry=True, min_pixels=60)
    scene, sequence = kinect_room(4, 20, walk), SequenceSegmenter(config)
    for k in range(0, 20, STEP):
        stamp = 10**9 + k * 10**9 // 30
        depth = simulate(scene, Kinect(0), CAMERA, frame=k, seed=4).depth
        recording.add_camera(stamp, 160, 120, k=CAMERA.matrix.ravel())
        recording.add_image(stamp, depth)
        sequence.segment(RangeImage.from_depth(depth, CAMERA), stamp)
    recording.write(tmp_path / 'recording')
    outcome = Replay(tmp_path / 'recording', tmp_path / 'out', config).run()
    assert outcome.mapped == len(sequence.map) >= 1 and not outcome.notes
    assert (tmp_path / 'out' / 'map.csv').exists()
    stamps, *places, x, y, z, w = np.loadtxt(tmp_path / 'out' / 'trajectory.txt').T
    np.testing.assert_allclose(stamps, 1 + np.arange(0, 20, STEP) / 30, atol=2e-9)
    ends = np.transpose(places)[[0, -1]]
    np.testing.assert_allclose(ends, [(0, 0, 0), sequence.motion.pose.shift], atol=1e-8)
    turn = Rotation.from_quat([x[-1], y[-1], z[-1], w[-1]]).as_matrix()
    np.testing.assert_allclose(turn, sequence.motion.pose.rotation, atol=1e-8)
    # Another frame: a map of its own, and the odometry begins at its origin.
    sequence.config = replace(config, odometry_frame='start')
    assert not len(sequence.map) and sequence.map.begun_anew == 'its frame has changed'
    assert sequence.motion is None
    with pytest.raises(ConfigError, match='odometry_frame'):
        Config(odometry=True, odometry_frame='')
