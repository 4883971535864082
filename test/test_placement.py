"""Where a camera is: frames, the accelerometer, the parameters; and how it is mounted."""

import re
from dataclasses import replace

import numpy as np
import pytest
from map_squares import plane
from planes_of_labels import painted
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.mapping.map_planes import moved_planes
from rangeseg_ros.core.mapping.mount import mount_of
from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.placement import Placement, Up, UpFilter, find_placement
from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import OPTICAL_IN_BODY, Pose, Scene
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera
from rangeseg_ros.simulation.solids import half_space

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
PITCH = Rotation.from_euler('y', 30, degrees=True)
MOUNT = Transform((PITCH * Rotation.from_matrix(OPTICAL_IN_BODY)).as_matrix(), np.array([0, 0, 1]))
SLANTED = np.s_[:, :], (0.2, -0.3, -0.9), 1.0
UP = (0, -np.cos(np.radians(30)), -np.sin(np.radians(30)))


def known(pairs=()):
    def lookup(target, source):
        if (target, source) not in pairs:
            raise TransformError(f'frame {target!r} is not known', ': 1 s late', True)
        return pairs[target, source]

    return lookup


def test_up_and_height_come_from_the_gravity_frame():
    lookup = known({('base_footprint', 'camera'): MOUNT})
    found = find_placement(Config(gravity_frame='base_footprint'), 'camera', lookup)
    (up,) = found.ups
    np.testing.assert_allclose(up.direction, UP, atol=1e-12)
    assert up.sd == Config().up_sd and found.asked
    assert found.height == 1 and found.sources == {'up': 'base_footprint'}
    assert not found.missing and not found.may_come


def test_without_it_the_accelerometer_tells_up_and_then_the_parameters():
    config = Config(gravity_frame='base_footprint', fixed_frame='odom')
    turned = Transform(Rotation.from_euler('z', 90, degrees=True).as_matrix(), np.ones(3))
    lookup = known({('camera', 'imu'): turned})
    found = find_placement(config, 'camera', lookup, ('imu', np.array([0, 9.8, 0])))
    np.testing.assert_allclose(found.ups[0].direction, (-1, 0, 0), atol=1e-12)
    # A tenth of gravity across it, even spread: 3.3 degrees.
    assert found.ups[0].sd == pytest.approx(np.hypot(1.5, 3.3), abs=0.01)
    assert found.sources['up'].startswith('imu in imu; no base_footprint')
    assert found.may_come and found.height is None and found.pose is None
    assert set(found.missing) == {'up', 'fixed frame'}
    # In the frame of the images no transform is needed; in an unknown one, parameters hold.
    assert len(find_placement(Config(), 'camera', known(), ('camera', np.ones(3))).ups) == 1
    found = find_placement(Config(), 'camera', known(), ('elsewhere', np.ones(3)))
    assert not found.ups and not found.may_come
    assert found.sources['up'].startswith('the parameters up_x, up_y, up_z; no imu in elsewhere')
    assert 'late' in found.sources['up'] and 'late' not in found.missing['up']


def test_planes_of_a_camera_elsewhere_are_those_planes_moved():
    """Also their covariance, that of the distance by the lever of the move."""
    there = replace(CAMERA, place=(3.0, -2.0, 0.5))
    (_, here), (_, (plane,)) = (painted(camera, SLANTED) for camera in (CAMERA, there))
    (expected,) = moved_planes(here, Transform(np.eye(3), np.array(there.place)))
    np.testing.assert_allclose(plane.normal, expected.normal, atol=1e-12)
    assert plane.distance == pytest.approx(expected.distance, abs=1e-9)
    np.testing.assert_allclose(plane.covariance, expected.covariance, rtol=1e-6)
    np.testing.assert_allclose(plane.hull, expected.hull, atol=1e-5)


def test_planes_of_another_frame_are_the_same_planes():
    _, (plane,) = painted(CAMERA, SLANTED)
    (moved,) = moved_planes([plane], MOUNT)
    points = plane.hull @ MOUNT.rotation.T + MOUNT.shift
    np.testing.assert_allclose(moved.hull, points, atol=1e-12)
    np.testing.assert_allclose(moved.hull @ moved.normal, -moved.distance, atol=1e-6)
    lever, there = (np.append(one.centroid, 1) for one in (plane, moved))
    assert there @ moved.covariance @ there == pytest.approx(lever @ plane.covariance @ lever)
    frame = Rotation.from_quat(moved.orientation).as_matrix()
    np.testing.assert_allclose(frame[:, 2], moved.normal, atol=1e-9)


@pytest.mark.parametrize(('parameter', 'expected'), [(0.0, 1.0), (0.9, 0.9)])
def test_the_height_counts_where_the_parameter_does_not(parameter, expected):
    image = RangeImage.from_depth(np.ones(CAMERA.shape, np.float32), CAMERA)
    sequence = SequenceSegmenter(Config(sensor_height=parameter))
    assert sequence.segment(image, 0, UP, height=1.0).source.sensor_height == expected
    with pytest.raises(ValueError, match='finite'):
        sequence.segment(image, 0, UP, height=np.nan)


def test_the_last_up_is_held_while_a_slope_can_be_told_from_level_ground():
    """tf stops: the error of what was up grows, and it is not taken for a level camera's."""
    up, config, filtered = np.array([0.0, -0.8, -0.6]), Config(up_drift=2.0), UpFilter()
    silent = Placement(asked=True, sources={'up': 'no tf'})

    def settle(seconds, found=silent, config=config):
        return filtered.settle(found, round(seconds * 1e9), config)

    assert settle(0).lost == 'no terrain, as up is not known: no tf'
    by_tf = Placement(ups=[Up(up, 1.5, 'tf')], asked=True, height=0.8, sources={'up': ''})
    told = settle(1, by_tf)
    assert (told.up_sd, told.height, told.lost) == (1.5, 0.8, '')
    held = settle(3)
    np.testing.assert_allclose(held.up, up, atol=1e-12)
    assert held.height == 0.8 and held.up_sd == pytest.approx(np.hypot(1.5, 2 * 2.0))
    assert held.sources['up'] == 'held for 2.0 s, +- 4.3 degrees: no tf'
    # Twice the error is more than the steepest ground, 12 degrees.
    limit = 1 + np.sqrt(6**2 - 1.5**2) / 2
    assert not settle(limit - 0.01).lost and settle(limit + 0.01).lost
    assert settle(limit + 0.01).up is None and settle(0.9).lost
    assert not settle(100, config=replace(config, up_drift=0.0)).lost
    # Where nobody asks, the parameters hold.
    nobody = Placement()
    assert filtered.settle(nobody, 0, config) is nobody


def test_an_up_that_is_held_turns_as_the_planes_do():
    filtered, none, up = UpFilter(), np.zeros((6, 6)), np.array([0.0, -1, 0])
    silent = Placement(asked=True, sources={'up': 'no tf'})
    # Pitches by a degree from frame to frame; turns about level axes become uncertain.
    turn = [
        Transform(Rotation.from_rotvec([np.radians(k), 0, 0]).as_matrix(), up) for k in range(60)
    ]
    grows, speed = np.diag([0, 0, 0, 1e-6, 9e-2, 3e-6]), np.radians([0, 0, 0, 10, 0, 0])
    path = [Motion('odom', t, k * grows, speed, none, 3) for k, t in enumerate(turn)]
    filtered.settle(replace(silent, ups=[Up(up, 1.5, 'tf')]), 0, Config(), None)
    for k, motion in enumerate(path[:-1]):
        placed = filtered.settle(silent, (k + 1) * 10**8, Config(), motion)
        np.testing.assert_allclose(placed.up, turn[k + 1].rotation.T @ up, atol=1e-9)
        sd = np.hypot(1.5, np.hypot(np.degrees(np.sqrt(k * 2e-6)), 0.2))
        assert placed.up_sd == pytest.approx(sd)
    assert 'held by planes for 5.9 s' in placed.sources['up']
    # An odometry that begins anew does not say where the camera was before.
    for motion in (None, path[-1]):
        assert filtered.settle(silent, 6 * 10**9, Config(), motion).lost


@pytest.mark.parametrize('sd', [(1.5, 1.5), (1.5, 3.6), (4.0, 0.5)])
def test_directions_are_weighted_by_their_precision_unless_they_contradict(sd):
    """Errors about two axes are that far apart once in a thousand times."""
    limit = np.hypot(*sd) * np.sqrt(chi2.ppf(0.999, 2))
    for angle in (0.99 * limit, 1.01 * limit):
        imu = Rotation.from_euler('x', -angle, degrees=True).apply((0, 0, 1))
        ups = [Up(np.array([0.0, 0, 1]), sd[0], 'tf'), Up(imu, sd[1], 'imu')]
        found = Placement(ups=ups, asked=True, sources={'up': ''})
        placed = UpFilter().settle(found, 1, Config())
        if angle > limit:
            assert f'tf and imu are {angle:.0f} degrees apart' in placed.lost and placed.up is None
        else:
            assert not placed.lost and np.linalg.norm(placed.up) == pytest.approx(1)
            assert placed.up_sd == pytest.approx(np.prod(sd) / np.hypot(*sd))
            share = np.degrees(np.arctan2(placed.up[1], placed.up[2])) / angle
            assert share == pytest.approx(sd[0] ** 2 / (sd[0] ** 2 + sd[1] ** 2), rel=0.01)


@pytest.mark.parametrize(('height', 'pitch', 'roll'), [(1.1, 25, 3), (0.9, 40, -20), (1.4, 30, 0)])
def test_the_mount_is_that_above_the_largest_plane_that_faces_up(height, pitch, roll):
    truth = Pose.looking((0, 0, height), 0, pitch, roll).rotation
    up, ahead = truth[2], truth[0]
    floor = plane(1, up, 2 * ahead - height * up, 0.01, 3.0)
    others = [plane(2, -ahead, 4 * ahead, 0.01, 9.0), plane(3, up, -0.5 * up, 0.01, 1.0)]
    mount = mount_of([*others, floor], 18, 10.0)
    assert [mount.roll, mount.pitch] == pytest.approx(np.radians([roll, pitch]), abs=1e-9)
    assert mount.height == pytest.approx(height) and not mount.doubts
    # As what draws from the covariance of the floor scatter by.
    mean, random = np.append(floor.normal, floor.distance), np.random.default_rng(0)
    x, y, z, drawn = random.multivariate_normal(mean, floor.covariance, 20000).T
    angles = np.arctan2(-x, -y), np.arcsin(-z / np.sqrt(x**2 + y**2 + z**2))
    assert mount.sigma == pytest.approx(np.std([*angles, drawn], axis=1), rel=0.05)
    # The camera's place in the frame on the floor, x forward.
    for turn in (Rotation.from_euler('xyz', mount.rpy), Rotation.from_quat(mount.quaternion)):
        np.testing.assert_allclose(turn.as_matrix(), truth, atol=1e-9)
    table = plane(4, up, -0.5 * up, 0.01, 2.8)
    least = np.degrees(mount.sigma[:2].max())
    for planes, frames, tolerance, doubt in (
        ([floor], 19, 10.0, 'it was found in 9 of 19 frames'),
        ([table, floor], 18, 10.0, 'a plane 0.50 m below the camera may be the floor as well'),
        ([floor], 18, 1.5, f'its direction is known to {least:.1f} degrees only'),
    ):
        assert mount_of(planes, frames, tolerance).doubts == [doubt]


def test_the_command_prints_what_ros_takes_and_says_when_there_is_no_floor(tmp_path, run):
    """A robot drives towards a wall; another camera sees the wall alone."""
    solids = half_space((0, 0, 1), (0, 0, 0)), half_space((-1, 0, 0), (4, 0, 0))
    robot = [Pose.looking((0.1 * k, 0, 1.1), 0, 25, 3) for k in range(4)]
    outcomes, camera = [], kinect_camera(320, 240)
    for name, poses in (('robot', robot), ('wall', [Pose.looking((0, 0, 1.5), 0, -20, 0)])):
        with DepthBagWriter(tmp_path / name, camera) as bag:
            for k in range(len(poses)):
                view = simulate(Scene(solids, tuple(poses)), Kinect(0), camera, frame=k)
                bag.write(view.depth, 10**9 + k * 10**8)
        outcomes.append(run('mount', tmp_path / name))
    (code, output, _), wall = outcomes
    assert code == 0
    told = re.findall(r'^(?:roll|pitch|height) (\S+) \+- (\S+)', output, re.MULTILINE)
    values, sigma = np.array(told, float).T
    error = np.abs(values - (3, 25, 1.1))
    assert (error < (1, 1, 0.02)).all() and (error < 4 * sigma).all()
    # The camera errs by no pose in its own frame.
    assert (sigma < (0.2, 0.2, 0.008)).all()
    assert '--frame-id base_footprint --child-frame-id camera_depth_optical_frame' in output
    assert '<origin xyz="0 0 1.' in output
    assert wall[0] == 2 and 'no plane that faces up' in wall[2]
