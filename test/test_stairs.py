"""Stairs as objects: edge, count, rise and run against simulated truth; the camera's tilt."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from pytest import approx
from replays import rows_of
from scipy.spatial.transform import Rotation
from terrain_scenes import CAMERA, FLOOR, scene, stated, view

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.batch.frame_files import write_frame
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.evaluation.stairs import StairsCheck, check_stairs, stairs_figures, stairs_line
from rangeseg_ros.simulation.solids import box
from rangeseg_ros.simulation.terrain.scene import ALL, Piece, slab

SIDES = -0.5, 0.6


def treads(edge, rise, run, class_, sides):
    """One tread for each of `sides`, and a landing as wide as the last one."""
    for k, y in enumerate(sides, 1):
        level, begin = k * rise if class_ == OBSTACLE else -k * rise, edge + (k - 1) * run
        end = begin + run + 3 * (k == len(sides))
        yield Piece(slab(begin, end, level, level, y), class_, abs(level))


def seen(*pieces, yaw=0):
    terrain = scene(*pieces, pitch=35, roll=2, yaw=yaw, height=1.5)
    image, _ = view(terrain)
    config = Config(**stated(terrain.up), sensor_height=1.5)
    return terrain, image, Segmenter(config).segment(image)


@pytest.mark.parametrize(
    ('direction', 'begin', 'count', 'rise', 'run'),
    [('up', 1.9, 3, 0.17, 0.28), ('down', 1.3, 4, 0.16, 0.3)],
)
def test_edge_count_rise_and_run(direction, begin, count, rise, run, tmp_path):
    class_ = OBSTACLE if direction == 'up' else DROP
    floor = FLOOR if direction == 'up' else slab(-3, begin, 0, 0, ALL)
    pieces = Piece(floor, GROUND), *treads(begin, rise, run, class_, count * [SIDES])
    terrain, image, result = seen(*pieces, yaw=10)
    (stairs,) = result.stairs
    assert (stairs.direction, stairs.count) == (direction, count)
    assert stairs.rise == approx(rise, abs=0.01) and stairs.run == approx(run, abs=0.025)
    assert stairs.width == approx(1.1, abs=0.1)
    edge = stairs.edge @ terrain.pose.rotation.T + terrain.pose.position
    assert edge[:, 0] == approx(begin, abs=0.06) and np.sort(edge[:, 1]) == approx(SIDES, abs=0.08)
    assert np.abs(edge[:, 2]).max() < 0.03
    # It is written as the contract says, and survives another process.
    path = write_frame(tmp_path, 'a', image, pickle.loads(pickle.dumps(result)), ['stairs'])
    (row,) = rows_of(path['stairs'])
    assert list(row)[:7] == [*(f'edge_{a}{k}' for k in (1, 2) for a in 'xyz'), 'width']
    assert row['direction'] == direction and int(row['count']) == stairs.count
    assert float(row['edge_x1']) == approx(stairs.edge[0, 0], abs=1e-6)


def test_the_edge_is_in_the_frame_of_a_cloud():
    steps = treads(1.9, 0.17, 0.28, OBSTACLE, 3 * [SIDES])
    terrain, image, result = seen(Piece(FLOOR, GROUND), *steps)
    turn, place = Rotation.from_rotvec((1.3, -0.7, 2.1)).as_matrix(), np.array([0.3, 0.2, 0.8])
    cloud = RangeImage.from_points((image.points @ turn.T + place).astype(np.float32))
    config = Config(**stated(turn @ terrain.up), sensor_height=1.5)
    (expected,), (stairs,) = result.stairs, Segmenter(config).segment(cloud).stairs
    ends = expected.edge @ turn.T + place
    # Which end is the first one depends on the axes.
    assert min(np.abs(stairs.edge - order).max() for order in (ends, ends[::-1])) < 0.02


@pytest.mark.parametrize(
    ('run', 'sides', 'count'),
    [
        (0.28, [ALL], None),
        (0.28, 2 * [SIDES], 2),
        (0.2, 3 * [SIDES], None),
        (0.45, 3 * [SIDES], None),
        # Noses as wide as treads share, of which each next pair has half in common, or less.
        (0.28, [(-0.8 + 0.3 * k, 0.2 + 0.3 * k) for k in range(3)], 3),
        (0.28, [(-0.2 - 0.35 * k, 0.8 - 0.35 * k) for k in range(3)], None),
        # No column sees the third tread and the fourth.
        (0.28, [(-0.6, 0.6), (-0.6, 0.6), (0, 0.6), (-0.6, 0), (-0.6, 0)], 3),
    ],
)
def test_treads_are_as_deep_as_is_built_and_follow_each_other(run, sides, count):
    result = seen(Piece(FLOOR, GROUND), *treads(1.9, 0.17, run, OBSTACLE, sides))[2]
    # Nothing is worked out unless it is asked for.
    assert not {'ground', 'stairs'} & set(vars(result))
    assert [stairs.count for stairs in result.stairs] == ([count] if count else [])
    assert 'ground' in vars(result)


@pytest.mark.parametrize('axis', [(1, 0, 0), (-1, 0, 0), (0, 0, 1)])
def test_a_tilted_camera_is_noticed_and_said(axis, segment_image):
    wall = Piece(box((1, 20, 6), np.eye(3), (3.5, 0, 0)), OBSTACLE, 3.0)
    terrain, image, straight = seen(Piece(FLOOR, GROUND), wall)
    assert straight.tilt is None
    wrong = Rotation.from_rotvec(np.radians(20) * np.array(axis)).apply(terrain.up)
    tilt = Segmenter(Config(**stated(wrong))).segment(image).tilt
    assert tilt.degrees == approx(np.degrees(np.arccos(wrong @ terrain.up)), abs=2)
    assert tilt.up == approx(terrain.up, abs=0.03)
    code, _, error = segment_image(view(terrain)[1].depth, CAMERA, **stated(wrong))
    assert code == 0 and 'up as stated, or of a level camera, is off by' in error


def test_figures_of_stairs_are_those_counted_on_paper():
    """A tread is in sight with 300 pixels that are at most 5 mm off its height."""
    row = {'direction': 'up', 'count': '3', 'rise': '0.2', 'run': '0.3'}
    height = np.zeros((3, 301), np.float32)
    height[0, :300], height[1, :300], height[2, :299] = 0.204, 0.406, 0.6
    up = SimpleNamespace(direction='up', count=2, rise=0.21, run=0.28)
    down = SimpleNamespace(direction='down')
    assert check_stairs(row, height, [down]) == (1, None, 1)
    height[1], height[2] = 0.4, 0.6
    assert check_stairs(row, height, [down, up]) == (3, (2, approx(0.01), approx(-0.02)), 1)
    assert check_stairs({**row, 'direction': 'down'}, -height, []) == (3, None, 0)
    assert check_stairs({}, height, [up, down]) == (0, None, 2)
    checks = [(3, (2, 0.01, -0.02), 1), (4, (4, -0.03, 0.04), 0), (5, (3, 0.02, 0.03), 0)]
    checks += [(2, None, 0), (1, (1, 0.5, 0.5), 0), (0, None, 2)]
    figures = stairs_figures([StairsCheck(*check) for check in checks])
    assert list(figures.values()) == approx([4, 3, 12, 9, 2, 0.02, 0.03, 0.03, 0.04, 3, 1])
    assert stairs_line(figures) == (
        'stairs: 3 of 4 found, 9 of their 12 treads in sight; median error of rise 20 mm, of run '
        '30 mm; 3 false alarms, 1 scenes without stairs'
    )
    assert 'median' not in stairs_line(stairs_figures([]))
