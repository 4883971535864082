"""Terrain of a robot that sees its own body and the head of a stair, over real DDS."""

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy')

from rclpy.serialization import serialize_message
from recordings import ROS2
from ros_bench import Bench

from rangeseg_ros import Camera, Config, RangeImage, Segmenter, corrected
from rangeseg_ros.core.ground.classes import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.messages.make import make_rclpy
from rangeseg_ros.messages.outputs import OUTPUTS

pytestmark = pytest.mark.ros

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
    depth[beyond] = np.divide(HEIGHT + DEEP, down, out=np.full_like(depth, 60.0), where=down > 0)[
        beyond
    ]
    depth[45:75, 100:130] = 0.9
    depth[body > 0] = 0.4
    depth[60:80, 20:40] = 0
    return np.round(1000 * np.minimum(depth, 8)).astype(np.uint16)


def written(message, name):
    """Bytes of a message; Fast CDR leaves those between aligned fields undefined."""
    kind = OUTPUTS[name].kind
    data = message if isinstance(message, bytes) else serialize_message(message)
    return bytes(ROS2.serialize_cdr(ROS2.deserialize_cdr(data, kind), kind))


def test_all_topics_of_terrain_leave_the_body_out(tmp_path):
    body = np.zeros(CAMERA.shape, np.uint8)
    body[90:, 40:120] = 255
    cv2.imwrite(str(tmp_path / 'mask.png'), body)
    given = dict(zip(('up_x', 'up_y', 'up_z'), map(float, UP), strict=True))
    given |= {'sensor_height': HEIGHT, 'mask': str(tmp_path / 'mask.png')}
    arguments = [word for name, value in given.items() for word in ('-p', f'{name}:={value}')]
    depth = head_of_a_stair(body)
    with (
        Bench(*arguments, camera=CAMERA) as bench,
        bench.listening('labels', *STAMPED, *MARKERS),
        bench.camera_on(),
    ):
        message = bench.image(depth)
        bench.segment(message)
        bench.until(lambda: all(bench.received[name] for name in (*STAMPED, *MARKERS)))
        received = {name: bench.received[name][0] for name in (*STAMPED, *MARKERS)}
    image = corrected(RangeImage.from_depth(depth, CAMERA), Config(**given))
    result = Segmenter(Config(**given)).segment(image)
    for name in (*STAMPED, *MARKERS):
        expected = OUTPUTS[name].message(make_rclpy, message.header, image, result)
        assert written(received[name], name) == written(expected, name), name

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
