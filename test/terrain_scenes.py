"""Ground, edges and what is on it before a camera, and shares of what is found of them."""

import cv2
import numpy as np

from rangeseg_ros import RangeImage
from rangeseg_ros.core.ground.cells import DROP, GROUND
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, Piece, Terrain, slab

CAMERA, KINECT = kinect_camera(320, 240), Kinect()
HEIGHT = 1.0
FLOOR = slab(-3, FAR, 0, 0, ALL)


def scene(*pieces, pitch=30, roll=0, yaw=0, height=HEIGHT):
    return Terrain('', pieces, (FLOOR,), Pose.looking((0, 0, height), yaw, pitch, roll))


def drop_of(depth, edge=1.7):
    return (
        Piece(slab(-3, edge, 0, 0, ALL), GROUND),
        Piece(slab(edge, FAR, -depth, -depth, ALL), DROP, depth),
    )


def gap(begin, end, depth, seen='surface'):
    return (
        Piece(slab(-3, begin, 0, 0, ALL), GROUND),
        Piece(slab(begin, end, -depth, -depth, ALL), DROP, depth, seen),
        Piece(slab(end, FAR, 0, 0, ALL), GROUND),
    )


def view(terrain, camera=CAMERA, seed=0, sensor=KINECT):
    """Image of a scene, and the truth."""
    frame = simulate_terrain(terrain, sensor, camera, seed)
    return RangeImage.from_depth(frame.depth, camera), frame


def stated(up):
    """The parameters that state a direction."""
    return dict(zip(('up_x', 'up_y', 'up_z'), map(float, up), strict=True))


def share(classes, frame, true, called):
    """Of the pixels of a class, away from its borders and within 3.5 m, those called `called`."""
    truth = cv2.erode((frame.terrain == true).astype(np.uint8), np.ones((7, 7))) > 0
    truth &= (frame.crossing if true == DROP else frame.depth / 1000) < 3.5
    assert truth.mean() > 0.003
    return (classes[truth] == called).mean()
