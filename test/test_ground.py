"""Scenes built to have a landing, a slope or a table taken for the ground the robot stands on."""

import cv2
import numpy as np
import pytest

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.core.ground.terrain import terrain_of
from rangeseg_ros.core.segmentation import STATED
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.sensors.kinect import Kinect
from rangeseg_ros.simulation.solids import box, prism
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import stated, terrain_scene
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, Piece, Terrain, slab

SEEN = np.degrees(np.arctan2(240, Kinect(0).camera.fy))  # below the middle of the image
CAMERA = 0.8
FLAT = slab(-3, FAR, 0, 0, ALL)


def found(pieces, pitch, height, up=None, seed=0, camera=CAMERA, yaw=0, config=None):
    pose = Pose.looking((0, 0, camera), yaw, pitch, 0)
    scene = Terrain('made', tuple(Piece(*piece) for piece in pieces), (FLAT,), pose)
    frame = simulate_terrain(scene, Kinect(seed), seed=seed)
    image = RangeImage.from_depth(frame.depth, Kinect(seed).camera)
    known = (height, 0.015) if height else (0.0, 0.0)
    up = scene.up if up is None else up
    return terrain_of(image, STATED, up, known, config or Config()), frame


def drop_at(edge, depth):
    return [(slab(-3, edge, 0, 0, ALL), GROUND), (slab(edge, FAR, -depth, -depth, ALL), DROP, 1.0)]


def share(terrain, frame, true, called):
    inside = cv2.erode((frame.terrain == true).astype(np.uint8), np.ones((7, 7)))  # 3 px
    near = (inside > 0) & (frame.depth < 3000)
    assert near.sum() > 1000
    return (terrain.classes[near] == called).mean()


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('depth', [0.06, 0.08, 0.1, 0.12, 0.15])
def test_a_landing_whose_edge_is_out_of_view_is_no_ground(depth, seed):
    """The floor is hidden up to 1.5 m ahead, and ends before."""
    pitch = np.degrees(np.arctan2(CAMERA, 1.5)) - SEEN
    terrain, frame = found(drop_at(0.9, depth), pitch, CAMERA, seed=seed)
    assert share(terrain, frame, DROP, GROUND) < 0.01
    assert not terrain.stand.found
    assert 'stated height is 0.80 m' in terrain.stand.reasons[0]


@pytest.mark.parametrize('depth', [0.06, 0.08, 0.1])
def test_a_strip_of_floor_at_the_lower_border_is_the_ground(depth):
    edge = CAMERA / np.tan(np.radians(28 + SEEN)) + 0.06
    terrain, frame = found(drop_at(edge, depth), 28, CAMERA + 0.01)
    assert share(terrain, frame, GROUND, GROUND) > 0.97
    assert share(terrain, frame, DROP, GROUND) < 0.01


@pytest.mark.parametrize('error', [-0.5, -0.2, -0.1, 0.1, 0.2, 0.5, 1.0])
def test_a_wrong_height_is_named_and_nothing_is_ground(error):
    terrain, _ = found(drop_at(1.5, 0.1), 30, CAMERA + error)
    assert not (terrain.classes == GROUND).any()
    assert f'stated height is {CAMERA + error:.2f} m' in terrain.stand.reasons[0]


@pytest.mark.parametrize('yaw', [-40, -20, 0])
def test_what_falls_to_the_side_by_20_degrees_is_no_ground(yaw):
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # from x, y to y, z of the world
    level = prism(np.array([(-0.2, -4), (8, -4), (8, 0), (-0.2, 0)]), 20, turn, (0, 0, 0))
    fall = -7.8 * np.tan(np.radians(20))
    side = prism(np.array([(-8, -9), (-0.2, -9), (-0.2, 0), (-8, fall)]), 20, turn, (0, 0, 0))
    terrain, frame = found([(level, GROUND), (side, DROP, 1.0)], 28, CAMERA, yaw=yaw)
    assert share(terrain, frame, DROP, GROUND) < 0.01
    assert yaw or share(terrain, frame, GROUND, GROUND) > 0.97


@pytest.mark.parametrize(('gap', 'kept'), [(0.15, 0.0), (0.5, 0.97)])
def test_ground_leads_over_gaps_that_the_robot_crosses(gap, kept):
    pieces = [
        (slab(-3, 1.2, 0, 0, ALL), GROUND),
        (slab(1.2, 1.5, -1, -1, ALL), DROP, 1.0),
        (slab(1.5, FAR, 0, 0, ALL), GROUND),
    ]
    config = Config(ground_gap=gap, robot_radius=gap + 0.1)
    terrain, frame = found(pieces, 28, CAMERA, config=config)
    beyond = (frame.terrain == GROUND) & (frame.depth > 2100) & (frame.depth < 2600)
    assert beyond.sum() > 1000
    assert abs((terrain.classes[beyond] == GROUND).mean() - kept) < 0.03


def test_a_table_alone_is_no_floor():
    table = box((1.2, 1.6, 0.03), np.eye(3), (0.8, 0, 0.7))
    pieces = [(FLAT, GROUND), (table, OBSTACLE, 0.7)]
    for height in (0.0, 1.2):
        terrain, frame = found(pieces, 50, height, camera=1.2)
        assert not (terrain.classes[frame.terrain == OBSTACLE] == GROUND).any()


def test_a_level_up_of_a_camera_that_looks_down_makes_nothing_ground():
    terrain, _ = found([(FLAT, GROUND)], 30, CAMERA, up=np.array([0.0, -1.0, 0.0]))
    assert not (terrain.classes == GROUND).any() and terrain.stand.reasons


def test_a_bridge_is_the_ground_and_not_what_is_beside_it():
    """The stated up and height are off: the bridge seems 3 cm too high, the rest 1 cm too low."""
    scene, sensor = terrain_scene('bridge', 84005), Kinect(84005)
    frame = simulate_terrain(scene, sensor, seed=84005)
    up, height = stated(scene, 84005)
    image = RangeImage.from_depth(frame.depth, sensor.camera)
    terrain = terrain_of(image, STATED, up, (height, 0.015), Config())
    assert share(terrain, frame, GROUND, GROUND) > 0.97
    assert share(terrain, frame, DROP, GROUND) < 0.01


@pytest.mark.parametrize('metres', [1e4, 1e6, 1e8])
def test_a_point_at_the_horizon_tells_no_height(metres):
    """Level with the camera, where errors of the inverse range are none of the height."""
    camera = Camera(2, 1, 1.0, 1.0, 1.0, 0.0)
    up = np.array([0.0, -1.0, 0.0])
    for beside in (0.0, 0.4 * metres, 0.8 * metres):
        image = RangeImage.from_depth(np.array([[metres, beside]], np.float32), camera, 1.0)
        for known in ((0.0, 0.0), (0.02, 0.015), (CAMERA, 0.015)):
            terrain = terrain_of(image, STATED, up, known, Config())
            assert not terrain.stand.found
            assert not (terrain.classes == GROUND).any()
