"""The node and tf over DDS: late, out of order, with a jump, missing; the map of planes."""

from importlib.util import find_spec

import numpy as np
import pytest

pytest.importorskip('rclpy')

import tf2_messages
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from ros_bench import FRAME, Bench, values_of
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from rangeseg_ros import planes_from_message
from rangeseg_ros.core.meaning.roles import ROLES
from rangeseg_ros.simulation.scenes import OPTICAL_IN_BODY

pytestmark = pytest.mark.ros

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# The camera 1.2 m above the ground, 35 degrees down; base_link is 0.3 m above the ground.
PITCH, HEIGHT, BASE = np.radians(35), 1.2, 0.3
FRAMES = {'gravity_frame': 'base_footprint', 'target_frame': 'base_link', 'fixed_frame': 'odom'}


def floor_depth(camera):
    """Depth of the ground, millimetres; 0 above the horizon."""
    down = camera.rays @ np.array([0, np.cos(PITCH), np.sin(PITCH)])
    with np.errstate(divide='ignore'):
        depth = np.where(down > 0.1, HEIGHT / down, 0)
    return np.round(1000 * depth).astype(np.uint16)


def transform(parent, child, stamp, rotation, shift):
    message = TransformStamped(child_frame_id=child)
    message.header.stamp, message.header.frame_id = stamp, parent
    for name, value in zip('xyzw', rotation.as_quat(), strict=True):
        setattr(message.transform.rotation, name, float(value))
    for name, value in zip('xyz', shift, strict=True):
        setattr(message.transform.translation, name, float(value))
    return message


class Robot:
    """Publishes tf: odom -> base_footprint -> base_link -> camera."""

    def __init__(self, bench, kind):
        self.bench, self.kind = bench, kind
        self.moving = bench.node.create_publisher(kind, '/tf', 100)
        self.static = bench.node.create_publisher(kind, '/tf_static', LATCHED)
        turn = Rotation.from_euler('y', PITCH) * Rotation.from_matrix(OPTICAL_IN_BODY)
        none = Rotation.identity()
        self.static.publish(
            kind(
                transforms=[
                    transform('base_footprint', 'base_link', Time().to_msg(), none, (0, 0, BASE)),
                    transform('base_link', FRAME, Time().to_msg(), turn, (0, 0, HEIGHT - BASE)),
                ]
            )
        )

    def at(self, stamp, x, yaw=0.0):
        """Where the robot is: x metres along the odometry's x axis."""
        turn = Rotation.from_euler('z', yaw)
        message = transform('odom', 'base_footprint', stamp, turn, (x, 0, 0))
        self.moving.publish(self.kind(transforms=[message]))


def later(stamp, seconds):
    return (Time.from_msg(stamp) + Duration(seconds=seconds)).to_msg()


def test_what_is_missing_is_said_where_there_is_no_tf():
    if find_spec('tf2_msgs'):
        pytest.skip('tf2_msgs is installed')
    settings = 'gravity_frame:=base_footprint', 'fixed_frame:=odom', 'stall_timeout:=60.0'
    bench = Bench(*(word for setting in settings for word in ('-p', setting)))
    try:
        with bench.listening('labels'), bench.camera_on():
            assert bench.segment().any()
            status = bench.status(lambda s: 'tf2_msgs' in s.message)
            assert 'ros-jazzy-tf2-msgs' in status.message
            values = values_of(status)
            assert values['up from'].startswith('the parameters up_x, up_y, up_z; no base_foot')
    finally:
        bench.close()


@pytest.fixture(scope='module')
def robot():
    patch = pytest.MonkeyPatch()
    problem = tf2_messages.provide(patch)
    if problem:
        patch.undo()
        pytest.skip(problem)
    from tf2_msgs.msg import TFMessage

    bench = Bench(
        *(f for k, v in FRAMES.items() for f in ('-p', f'{k}:={v}')), '-p', 'tf_timeout:=1.0'
    )
    try:
        with bench.listening('labels', 'planes', 'markers'), bench.camera_on():
            robot = Robot(bench, TFMessage)
            bench.until(lambda: robot.moving.get_subscription_count())
            bench.until(lambda: robot.static.get_subscription_count())
            yield robot
    finally:
        patch.undo()
        bench.close()


def send(robot, x, before=0.02, after=0.02, lag=0.0):
    """An image between two transforms, which may come late; planes and header of the answer."""
    bench = robot.bench
    image = bench.image(floor_depth(bench.camera))
    stamp = image.header.stamp
    bench.camera_info.publish(bench.info())
    if not lag:
        robot.at(later(stamp, -before), x)
        robot.at(later(stamp, after), x)
    bench.depth.publish(image)
    if lag:
        bench.spin(lag)
        assert not bench.find('planes', image)
        # Out of order, too.
        robot.at(later(stamp, after), x)
        robot.at(later(stamp, -before), x)
    message = bench.until(lambda: bench.find('planes', image))
    return planes_from_message(message), message.header


def test_planes_are_in_the_target_frame_and_the_ground_is_told_by_tf(robot):
    for lag in (0.0, 0.3):
        planes, header = send(robot, 0.0, lag=lag)
        assert header.frame_id == 'base_link'
        floor = planes[planes['role'] == ROLES.index('floor')]
        assert len(floor) == 1
        normal = [floor[f'normal_{axis}'][0] for axis in 'xyz']
        np.testing.assert_allclose(normal, (0, 0, 1), atol=0.01)
        assert floor['distance'][0] == pytest.approx(BASE, abs=0.01)
    bench = robot.bench
    markers = bench.received['markers'][-1]
    assert {m.header.frame_id for m in markers.markers} == {'base_link'}
    assert bench.received['labels'][-1].header.frame_id == FRAME
    values = values_of(bench.status(lambda s: 'up from' in values_of(s)))
    assert values['up from'] == 'base_footprint'
    assert values['fixed frame from'] == 'odom' and values['target frame from'] == 'base_link'


def test_the_map_is_latched_and_in_the_fixed_frame(robot):
    bench = robot.bench
    for k in range(8):
        send(robot, 0.1 * k)
    maps, markers = [], []
    here = [
        bench.node.create_subscription(PointCloud2, '/segment_planes/map', maps.append, LATCHED),
        bench.node.create_subscription(
            MarkerArray, '/segment_planes/map_markers', markers.append, LATCHED
        ),
    ]
    try:
        bench.until(lambda: all(s.get_publisher_count() for s in here))
        for k in range(8, 16):
            send(robot, 0.1 * k)
            bench.spin(0.15)
        bench.until(lambda: maps and markers)
        assert maps[-1].header.frame_id == 'odom'
        planes = planes_from_message(maps[-1])
        assert len(planes) == 1
        assert planes['normal_z'][0] == pytest.approx(1, abs=0.01)
        assert planes['distance'][0] == pytest.approx(0, abs=0.01)
        count = len(maps)
        # Whoever comes later has the last one at once.
        late = []
        here.append(
            bench.node.create_subscription(
                PointCloud2, '/segment_planes/map', late.append, LATCHED
            )
        )
        bench.until(lambda: late, 5.0)
        assert late[0] == maps[count - 1]
    finally:
        for subscription in here:
            bench.node.destroy_subscription(subscription)


def test_without_its_transforms_a_frame_waits_and_is_segmented_all_the_same(robot):
    bench = robot.bench
    image = bench.image(floor_depth(bench.camera))
    bench.camera_info.publish(bench.info())
    bench.depth.publish(image)
    bench.spin(0.4)
    assert not bench.find('planes', image)
    # A later one whose transforms are there does not wait for it.
    _, header = send(robot, 1.6)
    assert header.frame_id == 'base_link'
    # Far ahead of tf, and so without it once its time is up.
    ahead = bench.image(floor_depth(bench.camera))
    ahead.header.stamp = later(ahead.header.stamp, 30)
    bench.depth.publish(ahead)
    message = bench.until(lambda: bench.find('planes', ahead))
    assert message.header.frame_id == 'base_link'  # static, known at any time
    status = bench.status(lambda s: 'fixed frame odom' in s.message)
    assert status.level == DiagnosticStatus.WARN
    assert 'not known that late' in status.message
