"""Jump edges and shadows (thesis 5.5.2, 6.7): what lies before and behind stays apart.

A board before a parallel wall, seen by a structured-light sensor: where its projector stands
aside, the board casts a shadow on the wall, and every contour of the board ends in it.
"""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.grid import weights
from rangeseg_ros.core.sensing.jump_edges import jump_edges
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.simulation.solids import box, cast, half_space

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
WALL = 2.0
SIDES = {'left': (-1, 0, 0), 'right': (1, 0, 0), 'above': (0, -1, 0), 'beside': (-0.7, -0.7, 0)}
EDGE_STEP = 0.0065


def board(step, shadow, side, roll=0.0, turn=0.0):
    """Depth (H, W), 0 in the shadow, and where the board is seen (H, W).

    step: of the depth at the board, metres; shadow: its width, pixels; roll: of the board;
    turn: of all of the scene about the vertical; degrees.
    """
    depth = WALL - step
    turned = Rotation.from_euler('y', turn, degrees=True).as_matrix()
    rolled = Rotation.from_euler('z', roll, degrees=True).as_matrix()
    size = 0.4 * depth, 0.32 * depth, 0.001
    solids = [
        half_space(turned @ [0, 0, -1], turned @ [0, 0, WALL]),
        box(size, turned @ rolled, turned @ [0.01, 0.02, depth]),
    ]
    rays = CAMERA.rays.astype(float)
    distance, face = cast(solids, np.zeros(3), rays)
    projector = np.array(SIDES[side]) * shadow / (CAMERA.fx * (1 / depth - 1 / WALL))
    # Light ends at parameter 1 on the very surface, give or take rounding.
    bright = cast(solids, projector, distance[..., None] * rays - projector)[0] > 1 - 1e-7
    return np.where(bright, distance, 0).astype(np.float32), bright & (face > 0)


def mixed(found, front, valid):
    """Pixels on the wrong side: of parts (H, W) that hold pixels of both surfaces, the fewer."""
    count = int(found.max()) + 1
    of_front = np.bincount(found[front], minlength=count)
    of_wall = np.bincount(found[valid & ~front], minlength=count)
    return int(np.minimum(of_front, of_wall).sum())


def flooded(image, config):
    """Numbers (H, W) of what the links connect, whatever the normals."""
    grid = weights(image, jump_edges(image, config.jump_edges, config.edge_step))
    height, width = image.shape
    canvas = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    canvas[::2, ::2] = 1
    canvas[::2, 1::2], canvas[1::2, ::2] = grid[0] > 0, grid[1] > 0
    return cv2.connectedComponents(canvas, connectivity=4)[1][::2, ::2]


@pytest.mark.parametrize('side', SIDES)
@pytest.mark.parametrize('shadow', [0, 1, 4, 40])
@pytest.mark.parametrize(
    ('detector', 'steps'),
    # The smallest ones are 4 and 2 times `edge_step` in inverse range.
    [('sobel', (1.0, 0.2, 0.05, 0.03)), ('plane', (1.0, 0.1, 0.05))],
)
def test_no_link_joins_a_board_and_the_wall_behind_it(detector, steps, shadow, side):
    config = Config(jump_edges=detector, edge_step=EDGE_STEP)
    for step in steps:
        for roll, turn in ((0, 0), (20, 0), (45, 15)):
            depth, front = board(step, shadow, side, roll, turn)
            image = RangeImage.from_depth(depth, CAMERA)
            assert mixed(flooded(image, config), front, image.valid) == 0, (step, roll, turn)


@pytest.mark.parametrize('method', ['planes', 'normals'])
@pytest.mark.parametrize('detector', ['sobel', 'plane'])
@pytest.mark.parametrize('side', SIDES)
def test_no_region_holds_a_board_and_the_wall_behind_it(side, detector, method):
    """Down to the steps that the detector can see, but for a few pixels of a border."""
    config = Config(method=method, jump_edges=detector, edge_step=EDGE_STEP, min_pixels=100)
    for step in (1.0, 0.1, 0.05):
        for shadow in (0, 1, 12):
            depth, front = board(step, shadow, side, roll=5)
            image = RangeImage.from_depth(depth, CAMERA)
            labels = Segmenter(config).segment(image).labels
            judged = labels > 0
            assert mixed(labels, front & judged, judged) <= 30, (step, shadow)
            assert len(np.unique(labels[front & judged])) >= 1, (step, shadow)
