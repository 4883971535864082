"""The node and tf over DDS: late, out of order, with a jump, missing; the map of planes."""

import itertools
from importlib.util import find_spec

import numpy as np
import pytest

pytest.importorskip('rclpy')

import tf2_messages
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile
from recordings import Recording
from ros_bench import FRAME, assert_replayed, started, values_of
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from rangeseg_ros import Config, planes_from_message
from rangeseg_ros.batch.replay import Replay
from rangeseg_ros.messages.make import header_of, make_rclpy, nanoseconds
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.scenes import OPTICAL_IN_BODY
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

pytestmark = pytest.mark.ros

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# The camera 1.2 m above the ground, 35 degrees down; base_link is 0.3 m above the ground.
PITCH, HEIGHT, BASE = np.radians(35), 1.2, 0.3
LEVEL = 0, 0, 0, 1
TURN = (Rotation.from_euler('y', PITCH) * Rotation.from_matrix(OPTICAL_IN_BODY)).as_quat()
FRAMES = {'gravity_frame': 'base_footprint', 'target_frame': 'base_link', 'fixed_frame': 'odom'}


def floor_depth(camera, pitch=PITCH):
    """Depth of the ground, millimetres; 0 above the horizon."""
    down = camera.rays @ np.array([0, np.cos(pitch), np.sin(pitch)])
    depth = np.where(down > 0.1, HEIGHT / np.maximum(down, 0.1), 0)
    return np.round(1000 * depth).astype(np.uint16)


def tf(*transform):
    """Bytes of a message of tf with one transform, as `Recording.add_transform` has it."""
    recording = Recording()
    recording.add_transform(*transform)
    ((_, _, kind, message),) = recording.messages
    return bytes(recording.store.serialize_cdr(message, kind))


class Robot:
    """Publishes tf: odom -> base_footprint -> base_link -> camera."""

    def __init__(self, bench, kind):
        self.bench = bench
        self.moving = bench.node.create_publisher(kind, '/tf', 100)
        static = bench.node.create_publisher(kind, '/tf_static', LATCHED)
        static.publish(tf(0, 'base_footprint', 'base_link', LEVEL, (0, 0, BASE)))
        static.publish(tf(0, 'base_link', FRAME, TURN, (0, 0, HEIGHT - BASE)))
        bench.until(self.moving.get_subscription_count)
        bench.until(static.get_subscription_count)

    def around(self, stamp, x=0.0, z=0.0):
        """The robot is x metres along the odometry's x axis, z above it, before and after."""
        for time in (stamp - 20_000_000, stamp + 20_000_000):
            self.moving.publish(tf(time, 'odom', 'base_footprint', LEVEL, (x, 0, z)))


def sent(bench, robot=None, pitch=PITCH, ahead=0, **place):
    """An image of the ground, `ahead` seconds of the clock, and where the robot is."""
    image = bench.image(floor_depth(bench.camera, pitch))
    image.header.stamp.sec += ahead
    if robot:
        robot.around(nanoseconds(image.header.stamp), **place)
    return bench.send(image)


def test_what_is_missing_is_said_where_there_is_no_tf():
    if find_spec('tf2_msgs'):
        pytest.skip('tf2_msgs is installed')
    with started(**FRAMES, stall_timeout=60.0) as bench:
        assert bench.segment().any()
        status = bench.status(lambda s: 'tf2_msgs' in s.message)
        assert 'ros-jazzy-tf2-msgs' in status.message
        told = values_of(status)['up from']
        assert told.startswith('the parameters up_x, up_y, up_z; no base_foot')


@pytest.fixture(scope='module')
def tf_messages():
    """Class of the messages of tf, for processes started from here as well."""
    with pytest.MonkeyPatch.context() as patch:
        if problem := tf2_messages.provide(patch):
            pytest.skip(problem)
        from tf2_msgs.msg import TFMessage

        yield TFMessage


def test_node_and_replay_place_the_same_planes_whatever_becomes_of_tf(tmp_path, tf_messages):
    """At 50 Hz, out of order, late, from another publisher, and with a jump: byte for byte."""
    # Before the other tests, whose node would listen to the same camera.
    camera, late, restart, jump = kinect_camera(160, 120), 4, 6, 7
    depth = floor_depth(camera)
    recording = Recording()
    still = 0, 'base_footprint', 'optical', TURN, (0, 0, HEIGHT)
    recording.add_transform(*still, static=True)
    stamps = range(10**18, 10**18 + 600_000_000, 60_000_000)

    def sample(stamp):
        x = 2e-10 * (stamp - stamps[0])
        turn = Rotation.from_euler('z', 3 * x).as_quat()
        z = 0.5 * (stamp > stamps[jump] - 20_000_000)
        return stamp, 'odom', 'base_footprint', turn, (x, 0.0, z)

    groups = []
    for stamp in stamps:
        recording.add_camera(stamp, 160, 120, k=camera.matrix.ravel())
        recording.add_image(stamp, depth)
        # The last one is the first to tell where the image is, whatever comes first.
        groups.append([sample(stamp + 10_000_000 * after) for after in (-1, -3, 1)])
        for moving in groups[-1]:
            recording.add_transform(*moving)
    recording.messages[1:] = sorted(recording.messages[1:], key=lambda message: message[0])
    recording.write(tmp_path / 'recording')
    settings = {**FRAMES, 'target_frame': 'odom', 'tf_timeout': 60.0}
    topics = 'planes', 'markers', 'terrain'
    outcome = Replay(tmp_path / 'recording', tmp_path, Config(**settings), topics=topics).run()
    assert outcome.mapped == 1 and not outcome.notes

    with started(outputs=topics, camera=camera, **settings) as bench:
        static = bench.node.create_publisher(tf_messages, '/tf_static', LATCHED)
        moving = bench.node.create_publisher(tf_messages, '/tf', 100)
        static.publish(tf(*still))
        for n, group in enumerate(groups):
            if n == restart:
                bench.node.destroy_publisher(moving)
                moving = bench.node.create_publisher(tf_messages, '/tf', 100)
            bench.until(moving.get_subscription_count)
            image = bench.image(depth, header=header_of(make_rclpy, stamps[n], 'optical'))
            if n == late:
                bench.send(image)
                bench.spin(0.3)
                assert not bench.find('planes', image)
            for transform in group:
                moving.publish(tf(*transform))
            if n != late:
                bench.send(image)
            bench.until(lambda n=n: len(bench.received['markers']) == n + 1)
        told = f'{outcome.mapped} planes in odom'
        bench.status(lambda status: values_of(status).get('map from') == told)
        bench.status(lambda status: 'contradict' in values_of(status).get('poses from', ''))
    assert_replayed(bench, tmp_path, {n: OUTPUTS[n].kind for n in topics}, len(stamps))


def test_without_an_up_there_is_no_terrain(tf_messages):
    """Before tf, a minute after it stopped, of a camera knocked over, or set too high."""
    topics = 'terrain', 'obstacles', 'grid'

    def published(bench, *robot, **where):
        """Ground pixels, points of obstacles and free cells of an image."""
        image = sent(bench, *robot, **where)
        terrain, obstacles, grid = (bench.answer(name, image) for name in topics)
        ground = np.count_nonzero(np.frombuffer(terrain.data, np.uint8) == 1)
        return ground, obstacles.width, grid.data.count(0)

    with started(outputs=topics, gravity_frame='odom', tf_timeout=0.1, up_drift=0.2) as bench:
        assert published(bench)[0] == 0
        # Again and again: a node that hears nothing for a while says that instead.
        bench.error('no terrain, as up is not known', lambda: published(bench))
        robot = Robot(bench, tf_messages)
        bench.until(lambda: published(bench, robot)[0] > 0)
        ground, obstacles, free = published(bench)  # tf has stopped
        assert ground > 1000 and obstacles == 0 and free > 100
        assert published(bench, ahead=60) == (0, 0, 0)
        bench.error('not known', lambda: published(bench, ahead=60))
        found = []
        bench.status(
            lambda s: 'or a wrong height' in values_of(s).get('ground', ''),
            lambda: found.append(published(bench, robot, ahead=60, z=0.15)),
        )
        assert (0, 0) in {(ground, free) for ground, _, free in found}
        assert published(bench, robot, PITCH + np.radians(25), ahead=60) == (0, 0, 0)
        bench.error('is off by')
        # Half a metre above the ground is what is seen; of a held up, which is less sure, less is.
        sure = published(bench, robot, ahead=61, z=0.5)[1]
        assert 0 < published(bench, ahead=71)[1] < 0.9 * sure


def test_planes_hold_up_where_tf_has_stopped(tf_messages):
    """For longer than the 3 s by default, with the odometry."""
    settings = {'gravity_frame': 'odom', 'tf_timeout': 0.1, 'odometry': True}
    with started(outputs=['terrain'], **settings) as bench:
        robot = Robot(bench, tf_messages)
        for _ in range(2):  # the motion between two frames has kernels of its own
            bench.until(lambda: 1 in bench.answer('terrain', sent(bench, robot)).data)
        assert all(1 in bench.answer('terrain', sent(bench, ahead=k)).data for k in range(1, 9))
        bench.status(lambda s: 'held by planes' in values_of(s)['up from'])


@pytest.fixture(scope='module')
def robot(tf_messages):
    with started(outputs=('labels', 'planes', 'markers'), **FRAMES, tf_timeout=20.0) as bench:
        yield Robot(bench, tf_messages)


def test_the_map_is_latched_and_in_the_fixed_frame(robot):
    bench = robot.bench
    maps, markers, late, places = [], [], [], itertools.count()

    def listen(kind, name, received):
        bench.node.create_subscription(kind, f'/segment_planes/{name}', received.append, LATCHED)

    listen(PointCloud2, 'map', maps)
    listen(MarkerArray, 'map_markers', markers)
    # Published once a second.
    bench.repeat(
        lambda: bench.answer('planes', sent(bench, robot, x=0.1 * next(places))),
        lambda: len(maps) > 1 and markers,
    )
    assert maps[-1].header.frame_id == 'odom'
    (plane,) = planes_from_message(maps[-1])
    assert (plane['normal_z'], plane['distance']) == pytest.approx((1, 0), abs=0.01)
    # Whoever comes later has the last one.
    listen(PointCloud2, 'map', late)
    bench.until(lambda: late and late[-1] == maps[-1])


def test_without_its_transforms_a_frame_waits_and_is_segmented_all_the_same(robot):
    bench = robot.bench
    image = sent(bench)
    bench.spin(0.4)
    assert not bench.find('planes', image)
    # A later one whose transforms are there does not wait for it.
    assert bench.answer('planes', sent(bench, robot, x=1.6)).header.frame_id == 'base_link'
    bench.set_parameters(tf_timeout=0.5)
    # Far ahead of tf, and so without it once its time is up.
    ahead = sent(bench, ahead=30)
    # Static, and so known at any time.
    assert bench.answer('planes', ahead).header.frame_id == 'base_link'
    status = bench.status(lambda s: 'fixed frame odom' in s.message)
    assert status.level == DiagnosticStatus.WARN and 'not known that late' in status.message
