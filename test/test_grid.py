"""The grid of the ground around a robot: what it remembers and what it forgets."""

from dataclasses import replace

import numpy as np
import pytest
from terrain_scenes import drop_of, scene, stated, view

from rangeseg_ros import Config
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.ground.grid import GroundMemory
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.solids import box
from rangeseg_ros.simulation.terrain.scene import Piece

HEIGHT, EDGE, GROUND_IN_MAP = 0.8, 2.0, 0.3
FLOOR, LANDING = drop_of(0.15, EDGE)
BOX = Piece(box((0.2, 0.2, 0.3), np.eye(3), (1.4, 0.3, 0.15)), OBSTACLE, 0.3)


class Drive:
    """A camera on a robot that is at x, looking ahead; world: z up."""

    def __init__(self, posed=True, **parameters):
        self.pose = Pose.looking((0, 0, HEIGHT), 0, 30, 0)
        up, fixed = stated(self.pose.rotation[2]), 'map' if posed else ''
        config = Config(**up, fixed_frame=fixed, sensor_height=HEIGHT, **parameters)
        self.sequence = SequenceSegmenter(config)

    def grid(self, x, second, pieces=(FLOOR, LANDING, BOX)):
        pose = replace(self.pose, position=np.array([x, 0, HEIGHT]))
        image, _ = view(replace(scene(*pieces), pose=pose), seed=int(second))
        told = Transform(pose.rotation, np.add(pose.position, (0, 0, GROUND_IN_MAP)))
        at = told if self.sequence.config.map_frame else None
        return self.sequence.segment(image, int(1e9 * second), pose=at).grid


def at(grid, x, y, values=None):
    """Of the cell of a place in the frame of the grid."""
    column, row = np.floor((np.array([x, y]) - grid.origin[:2]) / grid.resolution).astype(int)
    return (grid.classes if values is None else values)[row, column]


def test_what_has_left_the_view_is_remembered_where_it_was():
    drive = Drive()
    for k in range(12):
        grid = drive.grid(0.1 * k, 0.2 * k)
    assert grid.frame == 'map' and grid.resolution == 0.05
    # 1.1 m on, the box is 0.3 m ahead and below the view.
    assert at(grid, 1.4, 0.3) == OBSTACLE and at(grid, 1.4, -0.3) == GROUND
    assert at(grid, 1.4, -0.3, grid.height) == pytest.approx(GROUND_IN_MAP, abs=0.02)
    assert grid.origin[2] == pytest.approx(GROUND_IN_MAP, abs=0.02)
    assert at(grid, 1.4, -0.3, grid.age) > 0.3
    assert np.isposinf(grid.age[np.isnan(grid.height) & (grid.classes == UNKNOWN)]).any()
    assert (grid.age >= 0).all()
    # Lethal is what lies beyond the edge, as long as rays cross the ground there.
    beyond = {at(grid, EDGE + 0.1 + 0.05 * k, 0.05 * n) for k in range(6) for n in range(-8, 8)}
    assert GROUND not in beyond and DROP in beyond
    assert at(grid, -1.0, 0.0) == UNKNOWN


def test_ground_that_is_seen_again_takes_danger_back_and_age_forgets():
    drive = Drive(grid_memory=5.0)
    for k in range(3):
        assert at(drive.grid(0, 0.1 * k), 1.4, 0.3) == OBSTACLE
    gone = [at(drive.grid(0, 1 + 0.1 * k, (FLOOR, LANDING)), 1.4, 0.25) for k in range(12)]
    assert gone[0] == OBSTACLE and gone[-1] == GROUND
    # At once when it is back.
    assert at(drive.grid(0, 3), 1.4, 0.25) == OBSTACLE
    wall = Piece(box((1, 20, 12), np.eye(3), (1.1, 0, 0)), OBSTACLE, 3.0)
    hidden = drive.grid(0, 9, (wall, FLOOR))
    assert at(hidden, 1.8, -0.3) == UNKNOWN and np.isinf(at(hidden, 1.8, -0.3, hidden.age))


@pytest.mark.parametrize(('posed', 'second'), [(False, 2), (True, 0)])
def test_without_poses_or_where_time_goes_back_the_grid_is_of_one_image(posed, second):
    drive = Drive(posed)
    assert OBSTACLE in drive.grid(0, 1).classes
    grid = drive.grid(0, second, (FLOOR, LANDING))
    assert grid.frame == ('map' if posed else '')
    assert OBSTACLE not in grid.classes and (grid.classes == GROUND).sum() > 300


@pytest.mark.parametrize(
    ('second', 'height', 'variance'),
    [(0.15, 0.14, 8e-5), (0.05, 0.06, 8e-5), (0.2, 0.2, 1e-4), (0.0, 0.0, 1e-4)],
)
def test_heights_of_a_cell_are_filtered_until_they_contradict(second, height, variance):
    memory = GroundMemory(Config())
    for seen, square in ((0.1, 4e-4), (second, 1e-4)):
        points = np.array([[0.01, 0.02, seen - 0.01], [0.02, 0.01, seen + 0.01]])
        memory._count(GROUND, points, np.full(2, square), 0.0)
    assert memory._layers[1, 0, 0] == pytest.approx(height)
    assert memory._layers[2, 0, 0] == pytest.approx(variance)
