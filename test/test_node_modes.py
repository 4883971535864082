"""The node under a lifecycle manager, at a target rate, and with a mask of the robot's body."""

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy')

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from message_classes import cdr
from processes import python
from ros_bench import Bench, benches, started, values_of

from rangeseg_ros import Camera, Config, RangeImage, Segmenter, corrected
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.sensing.binning import STEPS
from rangeseg_ros.messages.make import make_rclpy
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera

pytestmark = pytest.mark.ros


def test_a_managed_node_works_while_it_is_active():
    with Bench(managed=True, namespace='managed') as bench:
        bench.until(lambda: 'waits for a lifecycle manager' in bench.log())
        service = '/managed/segment_planes/change_state'
        client = bench.node.create_client(ChangeState, service)

        def change(kind, success=True):
            bench.until(client.service_is_ready)
            future = client.call_async(ChangeState.Request(transition=Transition(id=kind)))
            bench.until(future.done)
            assert future.result().success == success

        def subscribed():
            return bench.node.count_subscribers('/managed/depth/image_rect')

        with bench.listening('labels'):
            bench.spin(1.0)
            assert not subscribed()
            change(Transition.TRANSITION_ACTIVATE, success=False)
            change(Transition.TRANSITION_CONFIGURE)
            change(Transition.TRANSITION_CONFIGURE, success=False)
            bench.until(lambda: 'transition refused' in bench.log())
            for end in Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVE_SHUTDOWN:
                change(Transition.TRANSITION_ACTIVATE)
                bench.until(subscribed)
                change(end)
                bench.until(lambda: not subscribed())


def test_two_nodes_in_one_process():
    code = """
import os, sys
import rclpy
from rangeseg_ros.ros.node import SegmentPlanes
rclpy.init()
nodes = [SegmentPlanes(namespace=name) for name in ('front', 'rear')]
executor = rclpy.executors.SingleThreadedExecutor()
for node in nodes:
    executor.add_node(node)
executor.spin_once(1.0)
print(*(node.get_fully_qualified_name() for node in nodes))
print(*(publisher.topic_name for node in nodes for publisher in node.publishers
        if publisher.topic_name.endswith('/labels')))
sys.stdout.flush()
os._exit(0)  # while kernels are being compiled
"""
    done = python(code)
    assert done.returncode == 0, done.stderr
    names = ['/front/segment_planes', '/rear/segment_planes']
    assert done.stdout.split() == [*names, *(f'{name}/labels' for name in names)]


node, bench = benches('labels', 'status', camera=kinect_camera(161, 121))


def test_every_frame_is_made_again_with_what_it_records(bench):
    depth = simulate(kinect_room(2), Kinect(0), bench.camera, seed=2).depth
    offline = {}
    for step in STEPS:
        image = RangeImage.from_depth(depth, bench.camera)
        offline[step] = Segmenter(Config(work_budget=step)).segment(image).labels
    assert all((offline[1.0] != offline[step]).any() for step in STEPS[1:])

    def next_budget():
        image = bench.image(depth)
        labels = bench.segment(image)
        message = bench.answer('status', image)
        assert message.header == image.header
        recorded = float(values_of(message.status[0])['work_budget'])
        np.testing.assert_array_equal(labels, offline[recorded])
        return recorded

    assert [next_budget() for _ in range(3)] == [1.0] * 3
    # No machine does it: the least of the work, with steps on the way.
    assert bench.set_parameters(target_rate=1000.0)[0].successful
    assert bench.until(lambda: next_budget() == STEPS[-1])
    bench.status(lambda status: values_of(status)['work_budget'] == f'{STEPS[-1]:g}')
    # What every machine does, at once: the steering begins anew.
    assert bench.set_parameters(target_rate=0.001)[0].successful
    assert [next_budget() for _ in range(3)] == [1.0] * 3
    assert bench.set_parameters(target_rate=0.0, work_budget=STEPS[1])[0].successful
    assert [next_budget() for _ in range(2)] == [STEPS[1]] * 2


CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
PITCH = np.radians(35)
UP = np.array([0, -np.cos(PITCH), -np.sin(PITCH)])
HEIGHT, EDGE, DEEP = 1.0, 1.8, 0.5
STAMPED = ('terrain', 'ground', 'obstacles', 'drops', 'unseen', 'grid', 'grid_points')
MARKERS = ('outline', 'stairs', 'stairs_points')


def head_of_a_stair(body):
    """Depth, millimetres: a floor that ends `EDGE` ahead, a box on it, a bumper, and a gap."""
    down = -(CAMERA.rays @ UP)
    ahead = CAMERA.rays @ np.array([0, -np.sin(PITCH), np.cos(PITCH)])
    depth = np.divide(HEIGHT, down, out=np.full(CAMERA.shape, 60.0), where=down > 0)
    beyond = ahead * depth > EDGE
    depth[beyond] *= (HEIGHT + DEEP) / HEIGHT
    depth[45:75, 100:130] = 0.9
    depth[body > 0] = 0.4
    depth[60:80, 20:40] = 0
    return np.round(1000 * np.minimum(depth, 8)).astype(np.uint16)


def test_all_topics_of_terrain_leave_the_body_out(tmp_path):
    body = np.zeros(CAMERA.shape, np.uint8)
    body[90:, 40:120] = 255
    cv2.imwrite(str(tmp_path / 'mask.png'), body)
    given = dict(zip(('up_x', 'up_y', 'up_z'), map(float, UP), strict=True))
    given |= {'sensor_height': HEIGHT, 'mask': str(tmp_path / 'mask.png')}
    depth = head_of_a_stair(body)
    outputs = 'labels', *STAMPED, *MARKERS
    with started(outputs=outputs, camera=CAMERA, namespace='masked', **given) as bench:
        message = bench.image(depth)
        bench.segment(message)
        bench.until(lambda: all(bench.received[name] for name in (*STAMPED, *MARKERS)))
        received = {name: bench.received[name][0] for name in (*STAMPED, *MARKERS)}
    image = corrected(RangeImage.from_depth(depth, CAMERA), Config(**given))
    result = Segmenter(Config(**given)).segment(image)
    for name in (*STAMPED, *MARKERS):
        output = OUTPUTS[name]
        expected = output.message(make_rclpy, message.header, image, result)
        assert cdr(received[name], output.kind) == cdr(expected, output.kind), name

    terrain = np.frombuffer(received['terrain'].data, np.uint8).reshape(CAMERA.shape)
    assert (terrain[body > 0] == UNKNOWN).all()
    assert (terrain[60:80, 20:40] == UNKNOWN).all()
    assert (terrain[50:70, 105:125] == OBSTACLE).all()
    floor = (CAMERA.rays @ UP < 0) & (depth > 0) & (body == 0)
    floor[40:80, 95:135] = False
    level = -(depth / 1000) * (CAMERA.rays @ UP)
    assert (terrain[floor & (abs(level - HEIGHT) < 0.01)] == GROUND).mean() > 0.95
    fallen = floor & (abs(level - HEIGHT - DEEP) < 0.01)
    assert (terrain[fallen] == DROP).mean() > 0.95 and not (terrain[fallen] == GROUND).any()
    # Crossings lie on the ground continued, and not where the robot is itself.
    for name, deep in (('drops', True), ('unseen', False)):
        cloud = received[name]
        points = np.frombuffer(cloud.data, np.float32).reshape(-1, 4)
        assert len(points) > 100 and [f.name for f in cloud.fields] == ['x', 'y', 'z', 'height']
        np.testing.assert_allclose(points[:, :3] @ UP, -HEIGHT, atol=0.02)
        assert (points[:, 3] < -0.4).all() if deep else np.isnan(points[:, 3]).all()
        column = points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx
        row = points[:, 1] / points[:, 2] * CAMERA.fy + CAMERA.cy
        assert not (body[np.round(row).astype(int), np.round(column).astype(int)] > 0).any()
