"""Where a camera is: frames, the accelerometer, the parameters; and how it is mounted."""

from dataclasses import replace

import numpy as np
import pytest
from planes_of_labels import painted
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.mapping.map_planes import moved_planes
from rangeseg_ros.core.mapping.mount import mount_of
from rangeseg_ros.core.mapping.placement import Placement, Up, UpFilter, find_placement
from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import OPTICAL_IN_BODY, Pose, Scene
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera
from rangeseg_ros.simulation.solids import box, half_space

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
PITCH = Rotation.from_euler('y', 30, degrees=True)
MOUNT = Transform((PITCH * Rotation.from_matrix(OPTICAL_IN_BODY)).as_matrix(), np.array([0, 0, 1]))
SLANTED = np.s_[:, :], (0.2, -0.3, -0.9), 1.0
UP = (0, -np.cos(np.radians(30)), -np.sin(np.radians(30)))


def known(pairs=()):
    def lookup(target, source):
        if (target, source) not in pairs:
            raise TransformError(f'frame {target!r} is not known', may_come=True)
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
    back = moved_planes([moved], MOUNT.inverse())[0]
    np.testing.assert_allclose(back.normal, plane.normal, atol=1e-12)
    assert back.distance == pytest.approx(plane.distance)


@pytest.mark.parametrize(('parameter', 'expected'), [(0.0, 1.0), (0.9, 0.9)])
def test_the_height_counts_where_the_parameter_does_not(parameter, expected):
    down = -CAMERA.rays @ np.array(UP)
    depth = np.where(down > 0.1, 1 / np.maximum(down, 0.1), 0).astype(np.float32)
    sequence = SequenceSegmenter(Config(sensor_height=parameter))
    image = RangeImage.from_depth(depth, CAMERA)
    result = sequence.segment(image, 10**9, UP, height=1.0)
    assert result.survey.sensor_height == expected


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


@pytest.mark.parametrize('sd', [(1.5, 1.5), (1.5, 3.6), (4.0, 0.5)])
def test_directions_are_weighted_by_their_precision_unless_they_contradict(sd):
    """The mean of 4000 pairs of such errors has the error told; one of 1000 contradicts."""
    draw, filtered, config = np.random.default_rng(1), UpFilter(), Config()
    found, lost, ahead = [], 0, np.array([0.0, 0, 1])
    for _ in range(4000):
        errors = [np.append(draw.normal(0, np.radians(s), 2), 0) for s in sd]
        ups = [
            Up((e + ahead) / np.linalg.norm(e + ahead), s, name)
            for e, s, name in zip(errors, sd, ('tf', 'imu'), strict=True)
        ]
        placed = filtered.settle(Placement(ups=ups, asked=True, sources={'up': ''}), 0, config)
        lost += bool(placed.lost)
        if not placed.lost:
            found.append([*np.degrees(placed.up[:2]), placed.up_sd])
    x, y, told = np.array(found).T
    assert told[0] == pytest.approx(np.prod(sd) / np.hypot(*sd)) and np.ptp(told) == 0
    assert np.std([x, y]) == pytest.approx(told[0], rel=0.05)
    assert 0 < lost < 12
    apart = [Up(ahead, sd[0], 'tf'), Up(np.array([0, 0.6, 0.8]), sd[1], 'imu')]
    placed = filtered.settle(Placement(ups=apart, asked=True, sources={'up': ''}), 1, config)
    assert 'tf and imu are 37 degrees apart' in placed.lost and placed.up is None


MOUNTED = kinect_camera(320, 240)


def driving(height, pitch, roll, frames=6):
    """A robot drives past a box, towards a wall."""
    solids = half_space((0, 0, 1), (0, 0, 0)), half_space((-1, 0, 0), (4, 0, 0))
    cube = box((0.4, 0.4, 0.3), np.eye(3), (2.2, 0.7, 0.15))
    poses = [Pose.looking((0.1 * k, 0, height), 0, pitch, roll) for k in range(frames)]
    return Scene((*solids, cube), tuple(poses))


@pytest.mark.parametrize(('height', 'pitch', 'roll'), [(1.1, 25, 3), (0.9, 40, -6), (1.4, 30, 0)])
def test_angles_and_height_are_within_their_errors(height, pitch, roll):
    scene, sequence = driving(height, pitch, roll), SequenceSegmenter(Config(min_pixels=150))
    for k in range(len(scene.poses)):
        view = simulate(scene, Kinect(int(height * 10)), MOUNTED, frame=k)
        image = RangeImage.from_depth(view.depth, MOUNTED)
        sequence.segment(image, 10**9 + k * 10**8, pose=Transform.identity())
    mount = mount_of(sequence.map.planes, len(scene.poses), 10.0)
    assert not mount.doubts
    stated = *np.radians([roll, pitch]), height
    error = np.abs(np.subtract([mount.roll, mount.pitch, mount.height], stated))
    assert (error < [np.radians(1), np.radians(1), 0.02]).all() and (error < 4 * mount.sigma).all()
    # As what draws from the covariance of the floor scatter by.
    floor = max(sequence.map.planes, key=lambda plane: -plane.normal[1] * plane.area)
    mean, random = np.append(floor.normal, floor.distance), np.random.default_rng(0)
    x, y, z, drawn = random.multivariate_normal(mean, floor.covariance, 20000).T
    angles = np.arctan2(-x, -y), np.arcsin(-z / np.sqrt(x**2 + y**2 + z**2))
    assert mount.sigma == pytest.approx(np.std([*angles, drawn], axis=1), rel=0.05)
    # The camera's place in the frame on the floor, x forward.
    truth = scene.poses[0].rotation
    np.testing.assert_allclose(mount.rotation, truth, atol=0.03)
    for turn in (Rotation.from_euler('xyz', mount.rpy), Rotation.from_quat(mount.quaternion)):
        np.testing.assert_allclose(turn.as_matrix(), mount.rotation, atol=1e-9)


def test_the_command_prints_what_ros_takes_and_says_when_there_is_no_floor(tmp_path, run):
    scene = driving(1.1, 25, 3, frames=4)
    for name, pose in (('robot', None), ('wall', Pose.looking((0, 0, 1.5), 0, -20, 0))):
        with DepthBagWriter(tmp_path / name, MOUNTED) as bag:
            for k in range(4):
                shown = Scene(scene.solids, (pose or scene.poses[k],))
                bag.write(simulate(shown, Kinect(0), MOUNTED).depth, 10**9 + k * 10**8)
    params = tmp_path / 'params.yaml'
    params.write_text('min_pixels: 150')
    robot, wall = (run('mount', tmp_path / name, '--params', params) for name in ('robot', 'wall'))
    code, output, _ = robot
    assert code == 0
    assert '--frame-id base_footprint --child-frame-id camera_depth_optical_frame' in output
    assert '<origin xyz="0 0 1.' in output and 'pitch 2' in output
    assert wall[0] == 2 and 'no plane that faces up' in wall[2]
