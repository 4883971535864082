"""What other nodes build on, over real DDS: ids, roles, ground and obstacles, gravity."""

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Vector3
from recordings import record
from ros_bench import DEPTH, FRAME, assert_replayed, benches, started
from sensor_msgs.msg import Imu

from rangeseg_ros import ROLES, Camera, Config, planes_from_message
from rangeseg_ros.batch.replay import Replay
from rangeseg_ros.messages.motion import ODOMETRY
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.ros.locator import TIME_CONSTANT, Reading

pytestmark = pytest.mark.ros

HEIGHT, WALL, GRAVITY = 0.8, 3.0, 9.81
node, bench = benches('labels', 'planes')


def room(camera, wall=WALL):
    """Depth, millimetres, of a floor 0.8 m below a level camera, and of a wall."""
    down = camera.rays[..., 1]
    with np.errstate(divide='ignore'):
        floor = np.where(down > 0, HEIGHT / down, np.inf)
    return np.round(1000 * np.minimum(floor, wall)).astype(np.uint16)


def planes_of(bench, earlier=0):
    """Planes that the node finds in the room, by their roles."""
    image = bench.image(room(bench.camera))
    image.header.stamp.sec -= earlier
    bench.send(image)
    planes = planes_from_message(bench.answer('planes', image))
    roles = [ROLES[number] for number in planes['role']]
    # One plane for each role that is found.
    assert len(set(roles)) == len(roles)
    return dict(zip(roles, planes, strict=True))


def ids_of(planes):
    return {role: plane['id'] for role, plane in planes.items()}


def test_ids_outlive_a_change_of_parameters_and_end_with_time_running_back(bench):
    before = planes_of(bench)
    # From the next frame on the smaller plane is too small, and one frame later it is not.
    small, larger = sorted(before, key=lambda role: before[role]['count'])
    # By more than the few pixels that the labelling wins or loses with the parameter.
    bench.set_parameters(min_pixels=int(1.2 * before[small]['count']))
    assert ids_of(planes_of(bench)) == {larger: before[larger]['id']}
    bench.set_parameters(min_pixels=0)
    after = planes_of(bench)
    assert ids_of(after) == ids_of(before) and after['wall']['count'] == before['wall']['count']
    # A looped recording: known planes are others.
    early = ids_of(planes_of(bench, earlier=100)).values()
    assert len(early) == 2 and min(early) > max(ids_of(after).values())


def test_node_and_replay_say_the_same_of_a_recording(tmp_path):
    """All topics, byte for byte: another node, as ids are those since its start."""
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    frames = [room(camera, WALL - 0.01 * n) for n in range(4)]
    record(tmp_path / 'recording', 'mcap', frames)
    body = np.zeros(camera.shape, np.uint8)
    body[38:, 20:40] = 255
    cv2.imwrite(str(tmp_path / 'mask.png'), body)
    settings = {'odometry': True, 'mask': str(tmp_path / 'mask.png')}
    Replay(tmp_path / 'recording', tmp_path, Config(**settings), topics=tuple(OUTPUTS)).run()
    kinds = {name: output.kind for name, output in OUTPUTS.items()} | {'odometry': ODOMETRY}
    with started(outputs=kinds, namespace='robot', camera=camera, **settings) as bench:
        for n, depth in enumerate(frames):
            image = bench.image(depth)
            image.header.frame_id = 'optical'
            image.header.stamp.sec, image.header.stamp.nanosec = 10**9, n * 33_333_333
            bench.segment(image)
        bench.until(lambda: all(len(bench.received[name]) == len(frames) for name in kinds))
    assert_replayed(bench, tmp_path, kinds, len(frames))
    # The floor and a wall, which keep their ids.
    planes = [planes_from_message(cloud) for cloud in bench.received['planes']]
    assert all({ROLES[role] for role in found['role']} == {'floor', 'wall'} for found in planes)
    assert len({tuple(sorted(found['id'])) for found in planes}) == 1
    assert min(cloud.width for cloud in bench.received['ground']) > 300
    # The wall comes nearer: the camera goes forward, which is x of the odometry.
    last = bench.received['odometry'][-1]
    assert (last.header.frame_id, last.child_frame_id) == ('odom', 'optical')
    assert last.pose.pose.position.x == pytest.approx(0.03, abs=0.01)


def test_up_is_that_of_the_accelerometer_in_the_frame_of_the_images(bench):
    level = pytest.approx(HEIGHT, abs=3e-3)

    def subscription():
        (endpoint,) = bench.node.get_subscriptions_info_by_topic(DEPTH)
        return bytes(endpoint.endpoint_gid)

    before = subscription()
    bench.set_parameters(use_imu=True)
    with bench.advertised(Imu, '/imu') as publisher:
        bench.until(lambda: bench.node.count_subscribers('/imu'))
        bench.until(publisher.get_subscription_count)
        assert subscription() == before

        def height(x, y, z, frame=FRAME, covariance=0.0, seconds=None):
            """Height of what is the floor while the accelerometer measures that."""
            acceleration = Vector3(x=float(x), y=float(y), z=float(z))
            message = Imu(header=bench.header(), linear_acceleration=acceleration)
            message.header.frame_id = frame
            if seconds is not None:
                message.header.stamp.sec = seconds
            message.linear_acceleration_covariance[0] = covariance
            for _ in range(5):
                publisher.publish(message)
                bench.spin(0.02)
            # The node may take an image before measurements that have come before it.
            planes_of(bench)
            return planes_of(bench)['floor']['distance']

        # Nothing measured yet, then nothing that could be used.
        assert planes_of(bench)['floor']['distance'] == level
        awaited = 'no acceleration of rest yet'
        missing = bench.status(lambda s: awaited in s.message, lambda: planes_of(bench))
        assert missing.level == DiagnosticStatus.ERROR and 'no terrain' in missing.message
        for fields in ({'frame': 'imu_link'}, {'covariance': -1.0}):
            assert height(0, 0, -GRAVITY, **fields) == level
        for pushed in ((0, 0, -1.2 * GRAVITY), (np.nan, 0, 0), (0, 0, 0)):
            assert height(*pushed) == level
        # A camera looks down on the floor. For a while, up is as it was measured last.
        for frame in (FRAME, 'imu_link'):
            assert height(0, 0, -GRAVITY, frame) == pytest.approx(WALL, abs=6e-3)
        # Stamps before all time end nothing.
        for seconds in (-1, 1, -2):
            assert height(0, -GRAVITY, 0, seconds=seconds) == level
    bench.set_parameters(use_imu=False)
    bench.until(lambda: not bench.node.count_subscribers('/imu'))
    # One that is made anew loses what is sent until publishers have found it.
    assert subscription() == before
    # Who asks for no accelerometer gets none.
    assert planes_of(bench)['floor']['distance'] == level
    assert 'up imu in imu_link' in bench.log()


def test_acceleration_is_smoothed_by_the_time_constant():
    def after(*seconds, frame='optical'):
        reading = Reading('optical', 10**9, np.array([0.0, -1.0, 0.0]))
        for second in seconds:
            new = Reading(frame, 10**9 + round(second * 1e9), np.array([1.0, 0.0, 0.0]))
            reading = reading.followed_by(new)
        return reading.acceleration

    for seconds in (0.0, 0.01, TIME_CONSTANT, 5.0):
        left = np.exp(-seconds / TIME_CONSTANT)
        np.testing.assert_allclose(after(seconds), (1 - left, -left, 0), atol=1e-9)
    # Another sensor, or a recording that starts again.
    np.testing.assert_array_equal(after(0.01, frame='other'), (1, 0, 0))
    np.testing.assert_array_equal(after(-0.01), (1, 0, 0))
    # The same in one step as in many.
    np.testing.assert_allclose(after(*np.arange(0, 1.005, 0.01)), after(1.0), atol=1e-9)
