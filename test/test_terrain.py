"""Terrain: what robots fall into and run into, in scenes with known answers."""

from dataclasses import replace

import numpy as np
import pytest
from clouds import cloud_of
from scipy.spatial.transform import Rotation
from terrain_scenes import CAMERA, FLOOR, HEIGHT, KINECT, drop_of, gap, scene, share, stated, view

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN, cells_of
from rangeseg_ros.core.ground.points import drops, outlines, unseen
from rangeseg_ros.core.ground.reach import reach
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.sequence import SequenceSegmenter, with_roles
from rangeseg_ros.simulation.sensors.sensor import Ideal
from rangeseg_ros.simulation.solids import box
from rangeseg_ros.simulation.terrain import kinds
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, Piece, slab

PIT = 0.1, 'nothing'  # deep, of which nothing is measured


def found(terrain, height=HEIGHT, **parameters):
    """What is found of a scene with an up that is 1 degree per axis off, and the truth."""
    up = Rotation.from_euler('xyz', [1, -1, 1], degrees=True).apply(terrain.up)
    image, frame = view(terrain)
    config = Config(**stated(up), sensor_height=height, **parameters)
    return image, Segmenter(config).segment(image), frame


def in_the_world(points, terrain):
    return points @ terrain.pose.rotation.T + terrain.pose.position


@pytest.mark.parametrize('height', [HEIGHT + 0.01, 0.0])
@pytest.mark.parametrize(
    ('depth', 'roll'), [(0.08, 0), (0.5, 0), (0.15, 0), (0.15, 90), (0.15, 180), (0.15, -90)]
)
def test_below_a_drop_is_no_ground(depth, roll, height):
    _, result, frame = found(scene(*drop_of(depth), roll=roll), height)
    assert share(result.terrain, frame, GROUND, GROUND) > 0.99
    assert share(result.terrain, frame, DROP, GROUND) < 0.001
    assert share(result.terrain, frame, DROP, DROP) > 0.98
    # Without a height one ground in ten may lie behind a step.
    confidence = result.ground.stand.confidence
    assert confidence > 0.99 if height else confidence == 0.9
    deep = result.height[(frame.terrain == DROP) & (frame.crossing < 2.5)]
    assert np.median(deep) == pytest.approx(-depth, abs=0.03)


def test_a_mirage_in_the_floor_is_a_drop():
    mirror = Piece(slab(1.5, 2.3, 1e-6, 1e-6, (-0.5, 0.5)), DROP, 1.0, 'mirror')
    ceiling = Piece(box((20, 20, 1), np.eye(3), (0, 0, 2.9)), OBSTACLE, 2.4)
    wall = Piece(box((1, 20, 8), np.eye(3), (5.5, 0, 0)), OBSTACLE, 4.0)
    _, result, frame = found(scene(mirror, Piece(FLOOR, GROUND), ceiling, wall))
    assert share(result.terrain, frame, GROUND, GROUND) > 0.99
    assert share(result.terrain, frame, DROP, DROP) > 0.98


def test_a_whole_object_is_an_obstacle_and_has_its_height():
    low = Piece(box((0.3, 0.5, 0.08), np.eye(3), (1.75, -0.4, 0.04)), OBSTACLE, 0.08)
    high = Piece(box((0.3, 0.4, 0.4), np.eye(3), (1.95, 0.4, 0.2)), OBSTACLE, 0.4)
    _, result, frame = found(scene(low, high, Piece(FLOOR, GROUND)))
    assert share(result.terrain, frame, OBSTACLE, OBSTACLE) > 0.97
    assert share(result.terrain, frame, GROUND, GROUND) > 0.99
    error = (result.height - frame.height)[np.isfinite(frame.height) & (frame.depth < 3000)]
    assert np.median(np.abs(error)) < 0.01 and np.quantile(np.abs(error), 0.95) < 0.04
    assert not np.isfinite(result.height[frame.depth == 0]).any()


@pytest.mark.parametrize(
    ('kind', 'seed', 'class_'),
    [
        # Seen along it, a side of 6 cm is lost in what the ground may rise by between neighbours.
        ('curb', 930024, OBSTACLE),
        # The stated up and height are off: the bridge seems 3 cm too high, the rest 1 cm too low.
        ('bridge', 84005, DROP),
    ],
)
def test_what_is_beside_a_curb_or_bridge_is_told_from_it_as_a_whole(kind, seed, class_):
    terrain = kinds.terrain_scene(kind, seed)
    image, frame = view(terrain, KINECT.camera, seed)
    up, height = kinds.stated(terrain, seed)
    classes = Segmenter(Config(**stated(up), sensor_height=height)).segment(image).terrain
    assert share(classes, frame, class_, class_) > 0.95
    assert share(classes, frame, class_, GROUND) < 0.01
    assert share(classes, frame, GROUND, GROUND) > 0.98


def test_holes_are_no_scatter_of_cells():
    up, sensor = np.array([0, -np.cos(0.6), -np.sin(0.6)]), SensorModel.from_config(Config())
    inverse = -(CAMERA.rays @ up).astype(np.float32)
    inverse[(inverse < 0.1) | (np.random.default_rng(0).random(inverse.shape) < 0.3)] = 0
    cells = cells_of(RangeImage(CAMERA.rays, inverse, CAMERA), up, sensor, False)
    seen = cells.inverse > 0
    assert seen.mean() > 0.8 and (cells.variance[seen] > 0).all()


@pytest.mark.parametrize(('degrees', 'missed'), [(9, 0.0), (15, 0.1), (18, 0.01)])
def test_ramps_are_ground_as_long_as_they_are_not_steep(degrees, missed):
    """From their feet on: the steepest ground is 12 degrees, and up 1 degree off per axis."""
    top = 2 * np.tan(np.radians(degrees))
    class_ = GROUND if degrees < 12 else OBSTACLE
    ramp = Piece(slab(1.5, 3.5, 0, top, ALL), class_, top)
    floor = Piece(slab(-3, 1.5, 0, 0, ALL), GROUND)
    _, result, frame = found(scene(floor, ramp))
    assert share(result.terrain, frame, GROUND, GROUND) > 0.97
    planes = with_roles(result.planes, result.source.config, result.up)
    ramps = replace(result, planes=planes).ramps
    assert [ramp.slope for ramp in ramps] == [pytest.approx(9, abs=1)] * (degrees == 9)
    if class_ == OBSTACLE:
        assert share(result.terrain, frame, OBSTACLE, GROUND) < missed
        assert share(result.terrain, frame, OBSTACLE, OBSTACLE) > 0.85
    _, steeper, _ = found(scene(floor, ramp), ground_slope=25.0)
    assert (steeper.terrain == GROUND).sum() > 0.97 * (frame.depth > 0).sum()


@pytest.mark.parametrize('find', [drops, unseen])
@pytest.mark.parametrize('edge', [1.7, 3.0])
def test_crossings_leave_no_cell_of_a_costmap_free_beyond_an_edge(edge, find):
    """Cells of 5 cm, as far away as drops must be found; one more or less along the view."""
    terrain = scene(*(drop_of(0.3, edge) if find is drops else gap(edge, edge + 0.9, *PIT)))
    image, result, frame = found(terrain)
    points = find(image, result.ground)
    world = in_the_world(points[:, :3], terrain)
    near = (world[:, 0] > edge - 0.1) & (world[:, 0] < edge + 0.8)
    # On the ground continued.
    assert near.sum() > 500 and np.abs(world[near, 2]).max() < 0.05
    if find is drops:
        assert world[:, 0].min() > edge - 0.1 and (points[:, 3] < 0).all()
    else:
        assert np.isnan(points[:, 3]).all()
        assert (result.terrain[frame.depth == 0] == UNKNOWN).all()
        farthest = 1 / image.inverse[image.valid & (result.terrain <= GROUND)].min()
        assert points[:, 2].max() <= 1.0001 * farthest
    lethal = {(x + n, y) for x, y in np.floor(world[:, :2] / 0.05).astype(int) for n in (-1, 0, 1)}
    first = round(edge / 0.05) + 2
    assert {(x, y) for x in range(first, first + 6) for y in range(-10, 10)} <= lethal


def test_a_pit_is_unseen_in_a_cloud_as_well_and_outlined():
    """A cloud does not say where it looked: what it saw around tells."""
    terrain, count = scene(*gap(1.5, 2.2, *PIT)), []
    image, result, _ = found(terrain)
    cloud = cloud_of(image.points)
    for seen, of_it in ((image, result), (cloud, Segmenter(result.source.config).segment(cloud))):
        world = in_the_world(unseen(seen, of_it.ground)[:, :3], terrain)
        inside = (world[:, 0] > 1.45) & (world[:, 0] < 2.3)
        assert np.abs(world[inside, 2]).max() < 0.05
        count.append(inside.sum())
    assert count[1] > 0.8 * count[0] > 400
    edge = in_the_world(np.concatenate(outlines(image, result.ground)), terrain)
    assert (np.abs(edge[:, 0] - 1.5) < 0.06).sum() > 1


def test_stones_are_nearer_or_farther_than_the_ground_by_three_tenths_at_most():
    flat = scene(Piece(FLOOR, GROUND), height=0.4)
    scenes = replace(flat, relief=9.0), flat
    rough, smooth = (simulate_terrain(each, Ideal(0), CAMERA).depth for each in scenes)
    off = (rough / smooth)[smooth > 0] - 1
    assert [off.min(), off.max()] == pytest.approx([-0.3, 0.3], abs=1e-6)


def test_what_was_the_ground_stays_it_while_it_is_out_of_view():
    """Nor is a table the floor, nor a landing that is seen for a moment."""
    floor = Piece(FLOOR, GROUND)
    table = Piece(box((3.0, 6, 0.5), np.eye(3), (1.9, 0, 0.25)), OBSTACLE, 0.5)
    landing = Piece(slab(-3, FAR, -0.5, -0.5, ALL), DROP, 0.5)
    wall = Piece(box((1, 20, 12), np.eye(3), (1.4, 0, 0)), OBSTACLE, 4.0)
    views = {
        'floor': scene(floor, pitch=35),
        'table': scene(table, floor, pitch=35),
        'wall': scene(wall, floor, pitch=0),
        'landing': scene(landing, pitch=35),
    }
    images = {name: view(terrain)[0] for name, terrain in views.items()}
    sequence = SequenceSegmenter(Config())

    def ground_at(name, second):
        return sequence.segment(images[name], int(1e9 * second), views[name].up).ground

    def share(name, second, class_):
        return (ground_at(name, second).classes[images[name].valid] == class_).mean()

    # Of itself, each of them is the ground, but for the wall.
    assert share('wall', 0.0, OBSTACLE) > 0.999
    for name in ('table', 'landing', 'floor'):
        assert share(name, 0.0, GROUND) > 0.9
        sequence = SequenceSegmenter(Config())
    assert share('floor', 1.0, GROUND) > 0.95
    assert share('table', 1.1, OBSTACLE) > 0.9
    assert share('landing', 1.2, GROUND) < 0.01
    assert share('wall', 1.3, OBSTACLE) > 0.95
    assert 'm below, the height that is stated or remembered' in str(ground_at('wall', 1.4))
    assert share('floor', 1.5, GROUND) > 0.95
    # Neither an image nor those before it tell of a step out of view.
    assert ground_at('floor', 1.5).stand.confidence == 0.9
    # What holds while no ground is seen is forgotten in the end.
    patience = Config().track_time
    assert share('table', 1.4 + patience, GROUND) < 0.1
    assert share('landing', 1.6 + patience, GROUND) > 0.9
    # Where time begins anew, nothing is known.
    assert share('table', 0.0, GROUND) > 0.95


def test_what_is_off_the_ground_stays_off_as_far_as_its_surface_goes():
    """40 mm up, then 24, within half a step of the ground: 3 cells beside that may be reached."""
    rows, columns = np.indices((50, 40))
    top = (rows >= 10) & (rows < 40) & (columns < 20)
    place = np.stack([top * np.where(rows < 30, 0.04, 0.024), 0.5 + 0.02 * rows, 0.02 * columns])
    hidden = (rows >= 40) & (rows < 42) & (columns < 20)
    reached = reach(place, np.where(hidden, 0.0, 4e-6), Config())
    assert not (reached & top)[:, :17].any() and reached[:, 24:].all() and reached[42:].all()


def test_a_chain_comes_back_on_the_other_side_of_an_obstacle():
    """Ground that walls hide from the front and the right, but for two cells beside these."""
    rows, columns = np.indices((40, 40))
    wall = ((rows == 10) & (columns < 20)) | ((columns == 20) & (rows >= 10) & (rows < 30))
    place = np.stack([0.5 * wall, 0.5 + 0.02 * rows, 0.02 * (columns - 30)])
    reached = reach(place, np.full(rows.shape, 4e-6), Config(robot_radius=0.1, ground_gap=0.1))
    assert reached[13:, :18].all() and not reached[wall].any()


def test_a_chain_begins_straight_ahead():
    """On a bridge, 4 cm above a floor that comes into view beside it, and nearer."""
    rows, columns = np.indices((40, 60))
    beside = abs(columns - 30) > 5
    place = np.stack([-0.04 * beside, 1 + 0.02 * rows, 0.05 * (columns - 30)])
    reached = reach(place, np.where((rows < 5) & ~beside, 0.0, 4e-6), Config())
    assert reached[6:, 27:34].all() and not reached[:, beside[0]].any()
    # Or beside, where the ground comes into view farther away straight ahead.
    assert reach(place, np.where((rows < 30) & ~beside, 0.0, 4e-6), Config())[0].any()


def test_no_chain_goes_down_an_edge_that_is_blurred_over_two_cells():
    """Columns of 34 mm, 5.5 mm of noise: 38 mm down from the first on, with one cell between."""
    rows, columns = np.indices((60, 24))
    height = np.select([columns < 10, columns < 11], [0.0, -0.015], -0.038)
    height[rows < 12] = 0.0  # a chain starts where all is ground
    place = np.stack([height, 2.0 + 0.04 * rows, 0.034 * columns])
    reached = reach(place, np.full(rows.shape, 0.0055**2), Config())
    assert reached[:, :9].all() and not reached[20:, 10:].any()
    # Rows of 5 cm, 10 mm of noise: each part of the edge is lower by less than half a step.
    height = np.select([rows < 10, rows < 11, rows < 12], [0.0, -0.022, -0.036], -0.05)
    place = np.stack([height, 1.0 + 0.05 * rows, 0.034 * columns])
    assert not reach(place, np.full(rows.shape, 1e-4), Config())[11:].any()


def test_ground_between_a_wall_and_a_hole_is_no_slope():
    """Cells of 4 cm, 6 mm of noise: of 32 on either side the wall rises, and the hole falls."""
    rows, columns = np.indices((90, 40))
    hole = (rows >= 16) & (rows < 24) & (abs(columns - 20) < 8)
    height = np.where(hole, -0.5, 0.05 * np.maximum(rows - 50, 0))
    place = np.stack([height, 1 + 0.04 * np.minimum(rows, 50), 0.04 * (columns - 20)])
    reached = reach(place, np.full(rows.shape, 0.006**2), Config())
    assert reached[25:49].all() and not reached[hole].any() and not reached[51:].any()
