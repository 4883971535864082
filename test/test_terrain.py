"""Terrain: what robots fall into and run into, in scenes with known answers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from clouds import cloud_of
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN, cells_of
from rangeseg_ros.core.ground.estimate import HIGHEST, STEPS, continued
from rangeseg_ros.core.ground.points import drops, outlines, unseen
from rangeseg_ros.core.ground.reach import reach
from rangeseg_ros.core.ground.terrain import terrain_of
from rangeseg_ros.core.segmentation import STATED
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.sequence import SequenceSegmenter, with_roles
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.sensors.kinect import Kinect
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.solids import box, prism
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import stated, terrain_scene
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, Piece, Terrain, slab

CAMERA = resize(Kinect().camera, 320, 240)
HEIGHT = 1.0
FLOOR = slab(-3, FAR, 0, 0, ALL)


def scene(*pieces, pitch=30, roll=0, yaw=0, height=HEIGHT):
    return Terrain('', pieces, (FLOOR,), Pose.looking((0, 0, height), yaw, pitch, roll))


def drop_of(depth, edge=1.7):
    return (
        Piece(slab(-3, edge, 0, 0, ALL), GROUND),
        Piece(slab(edge, FAR, -depth, -depth, ALL), DROP, depth),
    )


def box_at(ahead, size, centre=0.0):
    length, width, height = size
    place = ahead + length / 2, centre, height / 2
    return Piece(box((length, width, height), np.eye(3), place), OBSTACLE, height)


def stated_to_be(up, height, **parameters):
    directions = dict(zip(('up_x', 'up_y', 'up_z'), map(float, up), strict=True))
    return Config(**directions, sensor_height=height, **parameters)


def up_of(terrain):
    """Off by 1 degree per axis."""
    return Rotation.from_euler('xyz', [1, -1, 1], degrees=True).apply(terrain.up)


def found(terrain, height=HEIGHT, **parameters):
    """What is found of a scene, and the truth."""
    frame = simulate_terrain(terrain, Kinect(), CAMERA)
    image = RangeImage.from_depth(frame.depth, CAMERA)
    config = stated_to_be(up_of(terrain), height, **parameters)
    return image, Segmenter(config).segment(image), frame


def in_the_world(points, terrain):
    return points @ terrain.pose.rotation.T + terrain.pose.position


def share(classes, frame, true, called):
    """Of the pixels of a class, away from its borders and within 3.5 m, those called `called`."""
    truth = cv2.erode((frame.terrain == true).astype(np.uint8), np.ones((7, 7))) > 0
    truth &= (frame.crossing if true == DROP else frame.depth / 1000) < 3.5
    assert truth.mean() > 0.003
    return (classes[truth] == called).mean()


@pytest.mark.parametrize('height', [HEIGHT + 0.01, 0.0])
@pytest.mark.parametrize('depth', [0.08, 0.15, 0.5])
def test_below_a_drop_is_no_ground(depth, height):
    _, result, frame = found(scene(*drop_of(depth)), height)
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
    boxes = box_at(1.6, (0.3, 0.5, 0.08), -0.4), box_at(1.8, (0.3, 0.4, 0.4), 0.4)
    _, result, frame = found(scene(*boxes, Piece(FLOOR, GROUND)))
    assert share(result.terrain, frame, OBSTACLE, OBSTACLE) > 0.97
    assert share(result.terrain, frame, GROUND, GROUND) > 0.99
    known = np.isfinite(frame.height) & (frame.depth < 3000)
    error = (result.height - frame.height)[known]
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
    terrain, sensor = terrain_scene(kind, seed), Kinect()
    frame = simulate_terrain(terrain, sensor, seed=seed)
    config = stated_to_be(*stated(terrain, seed))
    result = Segmenter(config).segment(RangeImage.from_depth(frame.depth, sensor.camera))
    assert share(result.terrain, frame, class_, class_) > 0.95
    assert share(result.terrain, frame, class_, GROUND) < 0.01
    assert share(result.terrain, frame, GROUND, GROUND) > 0.98


def test_holes_are_no_scatter_of_cells():
    up, sensor = np.array([0, -np.cos(0.6), -np.sin(0.6)]), SensorModel.from_config(Config())
    inverse = -(CAMERA.rays @ up).astype(np.float32)
    inverse[(inverse < 0.1) | (np.random.default_rng(0).random(inverse.shape) < 0.3)] = 0
    cells = cells_of(RangeImage(CAMERA.rays, inverse, CAMERA), up, sensor)
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
    planes = with_roles(result.planes, result.survey.config, result.up)
    ramps = replace(result, planes=planes).ramps
    assert [ramp.slope for ramp in ramps] == [pytest.approx(9, abs=1)] * (degrees == 9)
    if class_ == OBSTACLE:
        assert share(result.terrain, frame, OBSTACLE, GROUND) < missed
        assert share(result.terrain, frame, OBSTACLE, OBSTACLE) > 0.85
    _, steeper, _ = found(scene(floor, ramp), ground_slope=25.0)
    assert (steeper.terrain == GROUND).sum() > 0.97 * (frame.depth > 0).sum()


@pytest.mark.parametrize('roll', [0, 90, 180, -90])
def test_the_camera_may_be_rolled(roll):
    _, result, frame = found(scene(*drop_of(0.15, 1.4), pitch=35, roll=roll))
    assert share(result.terrain, frame, GROUND, GROUND) > 0.98
    assert share(result.terrain, frame, DROP, GROUND) < 0.002


def pit(begin, end):
    """Ten centimetres deep, of which nothing is measured."""
    return (
        Piece(slab(-3, begin, 0, 0, ALL), GROUND),
        Piece(slab(end, FAR, 0, 0, ALL), GROUND),
        Piece(slab(begin, end, -0.1, -0.1, ALL), DROP, 0.1, 'nothing'),
    )


@pytest.mark.parametrize('find', [drops, unseen])
@pytest.mark.parametrize('edge', [1.7, 3.0])
def test_crossings_leave_no_cell_of_a_costmap_free_beyond_an_edge(edge, find):
    """Cells of 5 cm, as far away as drops must be found; one more or less along the view."""
    terrain = scene(*(drop_of(0.3, edge) if find is drops else pit(edge, edge + 0.9)))
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
    lethal = {(x + n, y) for x, y in np.floor(world[:, :2] / 0.05).astype(int) for n in (-1, 0, 1)}
    first = round(edge / 0.05) + 2
    assert {(x, y) for x in range(first, first + 6) for y in range(-10, 10)} <= lethal


def test_a_pit_is_unseen_in_a_cloud_as_well_and_outlined():
    """A cloud does not say where it looked: what it saw around tells."""
    terrain, count = scene(*pit(1.5, 2.2)), []
    image, result, _ = found(terrain)
    cloud = cloud_of(image.points)
    for seen, of_it in ((image, result), (cloud, Segmenter(result.survey.config).segment(cloud))):
        world = in_the_world(unseen(seen, of_it.ground)[:, :3], terrain)
        inside = (world[:, 0] > 1.45) & (world[:, 0] < 2.3)
        assert np.abs(world[inside, 2]).max() < 0.05
        count.append(inside.sum())
    assert count[1] > 0.8 * count[0] > 400
    edge = in_the_world(np.concatenate(outlines(image, result.ground)), terrain)
    assert (np.abs(edge[:, 0] - 1.5) < 0.06).sum() > 1


def image_of(terrain):
    return RangeImage.from_depth(simulate_terrain(terrain, Kinect(), CAMERA).depth, CAMERA)


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
    images = {name: image_of(view) for name, view in views.items()}
    sequence = SequenceSegmenter(Config())

    def ground_at(name, second):
        return sequence.segment(images[name], int(1e9 * second), views[name].up).ground

    def share(name, second, class_):
        return (ground_at(name, second).classes[images[name].valid] == class_).mean()

    # Of itself, each of them is the ground.
    for name in ('table', 'landing', 'floor'):
        assert share(name, 0.0, GROUND) > 0.9
        sequence = SequenceSegmenter(Config())
    assert share('floor', 1.0, GROUND) > 0.95
    assert share('table', 1.1, OBSTACLE) > 0.9
    assert share('landing', 1.2, GROUND) < 0.01
    assert share('wall', 1.3, OBSTACLE) > 0.95
    hidden = ground_at('wall', 1.4)
    assert 'm below, as is known' in str(hidden)
    assert share('floor', 1.5, GROUND) > 0.95
    # Neither an image nor those before it tell of a step out of view.
    assert ground_at('floor', 1.5).stand.confidence == 0.9
    # What holds while no ground is seen is forgotten in the end.
    patience = Config().track_time
    assert share('table', 1.4 + patience, GROUND) < 0.1
    assert share('landing', 1.6 + patience, GROUND) > 0.9
    # Where time begins anew, nothing is known.
    assert share('table', 0.0, GROUND) > 0.95


def test_a_view_without_floor_has_no_ground():
    wall = Piece(box((1, 20, 12), np.eye(3), (1.9, 0, 0)), OBSTACLE, 4.0)
    for height in (HEIGHT, 0.0):
        _, result, frame = found(scene(wall, Piece(FLOOR, GROUND), pitch=0), height)
        assert (result.terrain != GROUND).mean() > 0.999
        assert (result.terrain == OBSTACLE)[frame.depth > 0].mean() > 0.99


def test_a_chain_goes_on_a_while_after_what_is_off_the_ground():
    """Rows of 2 cm: one 30 mm high, and from then on 16, within half a step but on the same."""
    rows, columns = np.indices((30, 9))
    height = np.select([rows < 10, rows < 11], [0.0, 0.03], 0.016)
    place = np.stack([height, 0.5 + 0.02 * rows, 0.02 * (columns - 4)])[:, ::-1]
    config = Config(robot_radius=0.1, ground_gap=0.1, ground_slope=30.0)
    reached = reach(place, np.full(rows.shape, 4e-6), config, False)[::-1]
    assert reached[:9].all() and not reached[9:13].any()
    # 16 mm and what is left of 14 more after 6 cm are within 25, half a step.
    assert reached[13:].all()


def test_no_chain_goes_down_an_edge_that_is_blurred_over_two_cells():
    """Columns of 34 mm, 5.5 mm of noise: 38 mm down from the first on, with one cell between."""
    rows, columns = np.indices((60, 24))
    height = np.select([columns < 10, columns < 11], [0.0, -0.015], -0.038)
    # A chain starts where all is ground.
    height[rows < 12] = 0.0
    place = np.stack([height, 2.0 + 0.04 * rows, 0.034 * columns])[:, ::-1]
    reached = reach(place, np.full(rows.shape, 0.0055**2), Config(), False)[::-1]
    assert reached[:, :9].all() and not reached[20:, 10:].any()


SEEN = np.degrees(np.arctan2(240, Kinect(0).camera.fy))  # below the middle of the image
ABOVE = 0.8


def judged(pieces, pitch, height, up=None, seed=0, camera=ABOVE, yaw=0, config=None):
    """Terrain as the camera's true or another up has it, and the truth."""
    terrain = scene(*pieces, pitch=pitch, yaw=yaw, height=camera)
    frame = simulate_terrain(terrain, Kinect(seed), seed=seed)
    image = RangeImage.from_depth(frame.depth, Kinect(seed).camera)
    known = (height, 0.015) if height else (0.0, 0.0)
    up = terrain.up if up is None else up
    return terrain_of(image, STATED, up, known, config or Config()), frame


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('depth', [0.06, 0.08, 0.1, 0.12, 0.15])
def test_a_landing_whose_edge_is_out_of_view_is_no_ground(depth, seed):
    """The floor is hidden up to 1.5 m ahead, and ends before."""
    pitch = np.degrees(np.arctan2(ABOVE, 1.5)) - SEEN
    terrain, frame = judged(drop_of(depth, 0.9), pitch, ABOVE, seed=seed)
    assert share(terrain.classes, frame, DROP, GROUND) < 0.01 and not terrain.stand.found
    assert 'stated height is 0.80 m' in terrain.stand.reasons[0]


@pytest.mark.parametrize('offset', [0.0, 0.02])
def test_the_ground_continued_errs_as_least_squares_say(offset):
    random, sd = np.random.default_rng(0), 0.003
    x, y = random.uniform((1, -1), (2, 1), (400, 2)).T
    h = offset + 0.03 * x - 0.01 * y + np.tile([0.002, -0.002], 200)
    seen = continued(np.stack([h, x, y]), np.full(400, sd**2), 0.01, Config())
    design = np.stack([np.ones(400), x, y], axis=1)
    plane, square, *_ = np.linalg.lstsq(design, h, rcond=None)
    assert seen.plane == pytest.approx(plane, abs=2e-4)
    # As if four cells that err alike were one. What they are off their plane goes on, from the
    # hundredth part of them that is nearest, over the longest way.
    start = np.sort(np.hypot(x, y))[4]
    bent = (1 + 2 * start / 3.2) * np.sqrt(square[0] / 400)
    known = 4 * sd**2 * np.linalg.inv(design.T @ design)[0, 0]
    assert seen.error == pytest.approx(np.sqrt(0.01**2 + known + bent**2), rel=1e-3)
    a, step = seen.plane[0], Config().least_step
    same = (1 - STEPS) * norm.pdf(a, scale=seen.error)
    tails = norm.sf(step, a, seen.error) + norm.cdf(-step, a, seen.error)
    other = STEPS * tails / (2 * (HIGHEST - step))
    assert seen.confidence == pytest.approx(same / (same + other), rel=1e-9)


@pytest.mark.parametrize('error', [-0.5, -0.2, -0.1, 0.1, 0.2, 0.5, 1.0])
def test_a_wrong_height_is_named_and_nothing_is_ground(error):
    terrain, _ = judged(drop_of(0.1, 1.5), 30, ABOVE + error)
    assert not (terrain.classes == GROUND).any()
    told = f'the stated height is {ABOVE + error:.2f} m, the ground seen is 0.80 m below, '
    (why,) = terrain.stand.reasons
    assert why.startswith(told) and why.endswith(
        ' sd: a step or ramp out of view, or a wrong height'
    )
    # Of the stated height, 0.015 m, and of what is seen, a few millimetres.
    assert float(why.removeprefix(told).split()[0]) == pytest.approx(abs(error) / 0.0166, abs=2)


@pytest.mark.parametrize('yaw', [-40, -20, 0])
def test_what_falls_to_the_side_by_20_degrees_is_no_ground(yaw):
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # from x, y to y, z of the world
    level = prism(np.array([(-0.2, -4), (8, -4), (8, 0), (-0.2, 0)]), 20, turn, (0, 0, 0))
    fall = -7.8 * np.tan(np.radians(20))
    side = prism(np.array([(-8, -9), (-0.2, -9), (-0.2, 0), (-8, fall)]), 20, turn, (0, 0, 0))
    pieces = Piece(level, GROUND), Piece(side, DROP, 1.0)
    terrain, frame = judged(pieces, 28, ABOVE, yaw=yaw)
    assert share(terrain.classes, frame, DROP, GROUND) < 0.01
    assert yaw or share(terrain.classes, frame, GROUND, GROUND) > 0.97


@pytest.mark.parametrize(('gap', 'kept'), [(0.15, 0.0), (0.5, 0.97)])
def test_ground_leads_over_gaps_that_the_robot_crosses(gap, kept):
    pieces = (
        Piece(slab(-3, 1.2, 0, 0, ALL), GROUND),
        Piece(slab(1.2, 1.5, -1, -1, ALL), DROP, 1.0),
        Piece(slab(1.5, FAR, 0, 0, ALL), GROUND),
    )
    config = Config(ground_gap=gap, robot_radius=gap + 0.1)
    terrain, frame = judged(pieces, 28, ABOVE, config=config)
    beyond = (frame.terrain == GROUND) & (frame.depth > 2100) & (frame.depth < 2600)
    assert beyond.sum() > 1000
    assert abs((terrain.classes[beyond] == GROUND).mean() - kept) < 0.03


def test_a_table_alone_is_no_floor():
    table = Piece(box((1.2, 1.6, 0.03), np.eye(3), (0.8, 0, 0.7)), OBSTACLE, 0.7)
    for height in (0.0, 1.2):
        terrain, frame = judged((Piece(FLOOR, GROUND), table), 50, height, camera=1.2)
        assert not (terrain.classes[frame.terrain == OBSTACLE] == GROUND).any()


def test_a_level_up_of_a_camera_that_looks_down_makes_nothing_ground():
    terrain, _ = judged([Piece(FLOOR, GROUND)], 30, ABOVE, up=np.array([0.0, -1.0, 0.0]))
    assert not (terrain.classes == GROUND).any() and terrain.stand.reasons


@pytest.mark.parametrize('metres', [1e4, 1e6, 1e8])
def test_a_point_at_the_horizon_tells_no_height(metres):
    """Level with the camera, where errors of the inverse range are none of the height."""
    camera = Camera(2, 1, 1.0, 1.0, 1.0, 0.0)
    up = np.array([0.0, -1.0, 0.0])
    for beside in (0.0, 0.4 * metres, 0.8 * metres):
        image = RangeImage.from_depth(np.array([[metres, beside]], np.float32), camera, 1.0)
        for known in ((0.0, 0.0), (0.02, 0.015), (0.8, 0.015)):
            terrain = terrain_of(image, STATED, up, known, Config())
            assert not terrain.stand.found and not (terrain.classes == GROUND).any()
