"""The rules of terrain one by one, on small cases whose answer is plain."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.meaning.cells import Cells, CellSize, axes_of, cells_of
from rangeseg_ros.core.meaning.classes import DROP, GROUND, HIDDEN, OBSTACLE, UNKNOWN
from rangeseg_ros.core.meaning.edges import below_edges
from rangeseg_ros.core.meaning.ground import CellTerrain
from rangeseg_ros.core.meaning.ground_field import GroundField
from rangeseg_ros.core.meaning.pixels import Said, decide, pixels_of
from rangeseg_ros.core.meaning.stairs import _find_level
from rangeseg_ros.core.meaning.steps import BASELINES, Steps
from rangeseg_ros.core.segmentation import STATED
from rangeseg_ros.evaluation.terrain import _near_borders
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.kinect import Kinect
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.solids import box
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import stated, terrain_scene
from rangeseg_ros.simulation.terrain.scene import ALL, Piece, Terrain, slab

SLOPE = float(np.tan(np.radians(13.5)))
STEPS = Steps.of(SLOPE, 0.05, np.ones(len(BASELINES)), 0.0)
ROWS, COLUMNS = 60, 24
AHEAD = np.linspace(4.0, 1.0, ROWS, dtype=np.float32)[:, None]  # the last row is nearest


@pytest.mark.parametrize('lens', [('', ()), ('plumb_bob', (0.1, -0.05, 0.001, 0.001, 0.0))])
def test_cells_are_the_means_of_their_pixels(lens):
    """Also where only some are measured, of lenses that distort, and at the end of the image."""
    camera = Camera(123, 485, 300.0, 310.0, 60.0, 240.0, 0.0, *lens)
    rng = np.random.default_rng(1)
    depth = rng.uniform(1, 3, camera.shape).astype(np.float32)
    depth[rng.random(camera.shape) < 0.3] = 0
    depth[:100] = 1.5
    image = RangeImage.from_depth(depth, camera)
    up = np.array([0.1, -0.9, -0.4]) / np.linalg.norm([0.1, -0.9, -0.4])
    size = CellSize.of(image.shape)
    cells = cells_of(image, size, up, STATED)
    for i, c in np.ndindex(cells.inverse.shape):
        part = (slice(i * size.rows, (i + 1) * size.rows),
                slice(c * size.columns, (c + 1) * size.columns))  # fmt: skip
        valid = image.valid[part]
        if 2 * valid.sum() < size.rows * size.columns:
            assert cells.inverse[i, c] == 0 and np.isnan(cells.place[:, i, c]).all()
            continue
        ray, value = image.rays[part][valid].mean(axis=0), image.inverse[part][valid].mean()
        assert cells.inverse[i, c] == pytest.approx(value, rel=1e-5)
        assert cells.ray[:, i, c] == pytest.approx(ray, abs=2e-5)
        assert cells.place[:, i, c] == pytest.approx(axes_of(up) @ ray / value, abs=1e-4)


def fallen(height, broken, steep=None, turned=False, rise=False):
    """`below_edges` of cells on straight columns at heights (ROWS, ...)."""
    place = np.zeros((3, *height.shape), np.float32)
    place[0], place[1], place[2] = height, AHEAD, 0.02 * np.arange(height.shape[1])
    flat = np.ones(height.shape, np.float32)
    cells = Cells(place, flat, place, flat, place[:2])
    steep = np.zeros_like(broken) if steep is None else steep
    return below_edges(height.astype(np.float32), cells, STEPS, steep, broken, turned, rise)


def test_beyond_an_edge_it_has_fallen_though_noise_makes_a_gap_in_it():
    height = np.zeros((ROWS, COLUMNS))
    height[:30] = -0.06
    broken = np.zeros((ROWS, COLUMNS), np.bool_)
    broken[29] = True
    broken[29, 10:13] = False
    expected = np.zeros_like(broken)
    expected[:30] = True
    np.testing.assert_array_equal(fallen(height, broken), expected)
    # Upside down the next row is the farther one.
    np.testing.assert_array_equal(fallen(height[::-1], broken, turned=True), expected[::-1])


@pytest.mark.parametrize('rise', [False, True])
def test_what_hides_an_edge_hides_no_drop_and_a_plank_across_it_stays(rise):
    """In more columns than those on either side can outvote; the same where the ground rises."""
    height = np.zeros((ROWS, COLUMNS))
    height[:30] = 0.06 if rise else -0.06
    broken = np.zeros((ROWS, COLUMNS), np.bool_)
    broken[29] = True
    broken[29, 4:19] = False
    expected = np.zeros_like(broken)
    expected[:30] = True
    np.testing.assert_array_equal(fallen(height, broken, rise=rise), expected)
    height[:30, 4:19] = 0
    assert not fallen(height, broken, rise=rise)[:, 7:16].any()


def test_at_the_border_of_the_image_a_hidden_edge_hides_no_drop():
    """There are columns on one side only; few of them tell nothing, nor do rises."""
    height = np.zeros((ROWS, 2 * COLUMNS))
    height[:30] = -0.06
    broken = np.zeros(height.shape, np.bool_)
    broken[29, 15:] = True
    for side in (1, -1):
        found = fallen(height[:, ::side], broken[:, ::side])
        np.testing.assert_array_equal(found, height[:, ::side] < 0)
    assert not fallen(-height, broken, rise=True)[:, :12].any()
    broken[29, 30:] = False
    assert not fallen(height, broken)[:, :12].any()
    broken[29, 30:], height[:30, :15] = True, 0
    assert not fallen(height, broken)[:, :12].any()


def test_aslant_a_trench_ends_at_the_border_of_the_image_first():
    far = 25 - np.arange(2 * COLUMNS) // 2
    row = np.arange(ROWS)[:, None]
    trench = (row >= far) & (row < 30)
    broken = np.isin(row, 29) | (row == far - 1)
    found = fallen(np.where(trench, -0.06, 0.0), broken)
    assert (found != trench).mean() < 0.01


def test_beside_what_fell_it_has_fallen_up_to_where_the_ground_rises():
    """An edge along the view, which no column crosses; a slope aside is none."""
    height = np.zeros((ROWS, COLUMNS))
    height[:30, :16] = -0.06
    broken = np.zeros((ROWS, COLUMNS), np.bool_)
    broken[29, :12] = True
    expected = np.zeros_like(broken)
    expected[:30, :16] = True
    np.testing.assert_array_equal(fallen(height, broken), expected)
    np.testing.assert_array_equal(fallen(height[:, ::-1], broken[:, ::-1]), expected[:, ::-1])
    height[:30, 12:] = -0.06 + 0.01 * np.arange(COLUMNS - 12)
    expected[:, 12:] = False
    np.testing.assert_array_equal(fallen(height, broken), expected)


def test_a_hole_ends_where_the_ground_comes_back():
    height = np.zeros((ROWS, COLUMNS))
    height[20:30] = -0.06
    broken = np.zeros((ROWS, COLUMNS), np.bool_)
    broken[29] = broken[19] = True
    result = fallen(height, broken)
    assert result[20:30].all() and not result[:20].any() and not result[30:].any()
    # A patch of noise beyond an edge of its own is no ground that comes back.
    height[:20], height[14:18] = -0.06, 0.0
    broken[19], broken[[13, 17]] = False, True
    assert fallen(height, broken)[:30].all()


def test_a_ramp_that_hides_behind_its_edge_and_single_columns_have_not_fallen():
    broken = np.zeros((ROWS, COLUMNS), np.bool_)
    broken[29] = True
    ramp = np.minimum(0, (AHEAD[30] - AHEAD) * 0.2) * np.ones(COLUMNS)
    hidden = np.zeros_like(broken)
    hidden[27:30] = True
    assert ramp[26, 0] < -0.025
    assert not fallen(ramp, broken, hidden).any()
    few = np.zeros((ROWS, COLUMNS))
    few[:30, 5:8] = -0.06
    assert not fallen(few, broken).any()


def test_nothing_is_claimed_that_the_noise_of_a_place_would_make():
    camera = Camera(32, 8, 300.0, 300.0, 16.0, 4.0)
    depth = np.full(camera.shape, 1.0, np.float32)
    image = RangeImage.from_depth(depth, camera)
    size = CellSize.of(image.shape)
    up = np.array([0.0, 0.0, -1.0])
    shape = image.shape[0], image.shape[1] // size.columns

    def classes(kind, unsure, height):
        # The ground is a plane across the optical axis, so much farther than what is measured.
        field = GroundField.of(np.array([[[0.0, 0.0, 1 / (1 + height)]]]), size, up)
        low, high, noise = (np.full(shape, x, np.float32) for x in (-0.025, 0.025, unsure))
        found, measured = pixels_of(image, field, size, Said(np.full(shape, kind, np.int8), low,
                                                             high, noise))  # fmt: skip
        assert measured == pytest.approx(height, abs=1e-5)
        (value,) = np.unique(found)
        return value

    assert [classes(UNKNOWN, 0.01, h) for h in (0, 0.04, -0.04)] == [GROUND, OBSTACLE, DROP]
    assert [classes(UNKNOWN, 0.05, h) for h in (0, 0.04, -0.04)] == [GROUND, UNKNOWN, UNKNOWN]
    assert [classes(UNKNOWN, 0.05, h) for h in (0.06, -0.06)] == [OBSTACLE, DROP]
    assert [classes(HIDDEN, 0.05, h) for h in (0, 0.04, 0.06, -0.06)] == [
        UNKNOWN, UNKNOWN, OBSTACLE, DROP,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ('unsure', 'low', 'beside', 'deeper'),
    [(0.01, -0.025, -0.025, -0.025), (0.035, -0.035, -0.015, np.inf), (1, -0.04, np.inf, np.inf)],
)
def test_beside_a_drop_ground_is_what_could_not_be_the_drop(unsure, low, beside, deeper):
    """As far as cells err alike; beside what only may be a drop, no noise excuses what is low."""
    rows, columns = 20, 9
    surface = np.zeros((rows, columns), np.int32)
    surface[:5, :4], surface[14, 2] = 1, 2
    verdict = np.array([UNKNOWN, DROP, HIDDEN], np.int8)
    none = np.zeros(surface.shape, np.bool_)
    height = np.where(surface > 0, np.float32(-0.05), np.float32(0))
    height[8, 5] = -0.016
    noise = np.full(surface.shape, unsure, np.float32)
    said = decide(
        verdict, surface, surface == 0, none, none, height, noise, (0.05, 0.05), 0.04, (6, 3)
    )
    expected = np.full(surface.shape, low, np.float32)
    expected[:7, :5] = expected[12:17, 1:4] = -0.025
    if unsure > 0.025:
        expected[:11, :7] = beside
        expected[8, 5] = deeper
    ground = surface == 0
    np.testing.assert_allclose(said.low[ground], expected[ground], atol=1e-6)


def test_bits_of_a_tread_are_level_though_most_of_it_is_not_measured():
    rows = 40
    height = np.zeros((rows, 3), np.float32)
    height[:20] = np.nan
    height[[8, 11]] = 0.17
    height[2], height[5] = 0.5, 0.34  # no two alike: a riser
    place = np.zeros((3, rows, 3), np.float32)
    place[1] = np.linspace(2.4, 1.0, rows)[:, None]
    kind = np.where(height == 0, GROUND, UNKNOWN).astype(np.int8)
    cells = CellTerrain(place, height, kind, np.full_like(height, 0.01), False)
    level = _find_level(cells, 1, 1.0)
    assert (level[[8, 11]] == np.float32(0.17)).all()
    assert not level[[2, 5]].any() and not level[20:].any()


@pytest.mark.parametrize(('falls', 'confident'), [(False, True), (True, False)])
def test_without_a_height_the_edge_of_a_surface_tells_how_sure_it_is(falls, confident):
    """Walls stand where a floor ends; a platform falls off on all sides."""
    camera = resize(Kinect().camera, 160, 120)
    floor = Piece(slab(-3, 2.5, 0, 0, ALL), GROUND)
    end = (Piece(slab(2.5, 12, -0.7, -0.7, ALL), DROP, 0.7) if falls
           else Piece(box((1, 20, 4), np.eye(3), (3.0, 0, 0)), OBSTACLE, 2.0))  # fmt: skip
    pose = Pose.looking((0, 0, 1.0), 0, 25, 0)
    terrain = Terrain('', (floor, end), (slab(-3, 12, 0, 0, ALL),), pose)
    frame = simulate_terrain(terrain, Kinect(), camera, 1)
    up = dict(zip(('up_x', 'up_y', 'up_z'), map(float, terrain.up), strict=True))
    ground = Segmenter(Config(**up)).segment(RangeImage.from_depth(frame.depth, camera)).ground
    assert (ground.stand.confidence > 0.5) == confident
    assert ('it may be a table or a platform' in str(ground)) != confident


def test_a_level_that_noise_hides_is_not_the_ground_where_single_places_look_like_it():
    """Noise alike over many pixels, as of a stereo camera, is as large as a step of 5 cm there."""
    camera = resize(Kinect().camera, 320, 240)
    floor = Piece(slab(-3, 2, 0, 0, ALL), GROUND)
    low = Piece(slab(2, 12, -0.05, -0.05, ALL), DROP, 0.05)
    pose = Pose.looking((0, 0, 1.2), 0, 30, 0)
    terrain = Terrain('', (floor, low), (slab(-3, 12, 0, 0, ALL),), pose)
    frame = simulate_terrain(terrain, Kinect(), camera, 3)
    rng = np.random.default_rng(2)
    noise = cv2.GaussianBlur(rng.normal(size=camera.shape), (0, 0), 2)
    inverse = np.where(frame.depth > 0, 1000 / np.maximum(frame.depth, 1), 0)
    inverse += 0.005 * noise / noise.std()
    depth = np.where(frame.depth > 0, 1 / inverse, 0).astype(np.float32)
    up = Rotation.from_euler('x', 1, degrees=True).apply(terrain.up)
    stated = dict(zip(('up_x', 'up_y', 'up_z'), map(float, up), strict=True))
    config = Config(**stated, sensor_height=1.21)
    found = Segmenter(config).segment(RangeImage.from_depth(depth, camera)).terrain
    judged = cv2.erode((frame.terrain == DROP).astype(np.uint8), np.ones((7, 7))) > 0
    judged &= frame.crossing < 2.5
    assert judged.sum() > 1000
    assert (found[judged] == GROUND).mean() < 0.01


def test_a_small_image_whose_floor_is_partly_hidden_has_ground():
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    down = camera.rays[..., 1]
    floor = np.divide(0.8, down, out=np.full(camera.shape, 3.0), where=down > 0)
    depth = np.round(1000 * np.minimum(floor, 3.0)).astype(np.uint16)
    body = np.zeros(camera.shape, np.bool_)
    body[44:, :20] = True
    result = Segmenter(Config()).segment(RangeImage.from_depth(depth, camera).without(body))
    np.testing.assert_array_equal(result.terrain == GROUND, (depth < 3000) & ~body)


@pytest.mark.parametrize(
    ('kind', 'seed', 'class_'), [('hole', 955078, DROP), ('low boxes', 955055, OBSTACLE)]
)
def test_little_is_called_ground_that_the_noise_nearly_hides(kind, seed, class_):
    """A hole 6 cm deep at 2.5 m, and boxes of 5 to 7 cm beside ground that comes back."""
    scene, sensor = terrain_scene(kind, seed), SENSORS['realsense'](seed)
    frame = simulate_terrain(scene, sensor, seed=seed)
    up, height = stated(scene, seed)
    x, y, z = map(float, up)
    config = Config(up_x=x, up_y=y, up_z=z, sensor_height=height)
    terrain = Segmenter(config).segment(RangeImage.from_depth(frame.depth, sensor.camera)).terrain
    there = (frame.terrain == class_) & (frame.crossing < 2.5)
    inside = cv2.erode(there.view(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert inside.sum() > 2000 and (terrain[inside] == GROUND).mean() < 0.008


@pytest.mark.parametrize('seed', [1710099, 1710061, 1920182, 2020141])
def test_a_level_beyond_an_edge_is_told_as_a_whole(seed):
    """5 cm down at more than 2 m: no pixel of a stereo camera tells, all of them together do."""
    scene, sensor = terrain_scene('drop', seed), SENSORS['realsense'](seed)
    frame = simulate_terrain(scene, sensor, seed=seed)
    up, height = stated(scene, seed)
    config = Config(up_x=up[0], up_y=up[1], up_z=up[2], sensor_height=height)
    terrain = Segmenter(config).segment(RangeImage.from_depth(frame.depth, sensor.camera)).terrain
    there = (frame.terrain == DROP) & (frame.crossing <= 2.5)
    drop = terrain[there & ~_near_borders(frame.terrain)]
    assert np.mean(drop == DROP) >= 0.95
    # What docs/navigation.md counts as a failure.
    assert np.mean(drop == GROUND) <= 0.01


def test_what_noise_lifts_of_a_drop_is_no_ground():
    """A corner of a hole 6 cm deep, 2.4 m ahead: a patch of smooth errors lifts it by 5 cm."""
    scene, sensor = terrain_scene('hole', 2120196), SENSORS['realsense'](2120196)
    frame = simulate_terrain(scene, sensor, seed=2120196)
    up, height = stated(scene, 2120196)
    config = Config(up_x=up[0], up_y=up[1], up_z=up[2], sensor_height=height)
    terrain = Segmenter(config).segment(RangeImage.from_depth(frame.depth, sensor.camera)).terrain
    there = (frame.terrain == DROP) & (frame.crossing <= 2.5) & ~_near_borders(frame.terrain)
    assert there.sum() > 600
    assert np.mean(terrain[there] == GROUND) <= 0.01


def test_ground_beyond_a_trench_is_no_part_of_it():
    """Of a stereo camera, noise hides the far edge of a trench 5 cm deep in some columns."""
    floor = Piece(slab(-3, 1.5, 0, 0, ALL), GROUND)
    trench = Piece(slab(1.5, 1.8, -0.05, -0.05, ALL), DROP, 0.05)
    beyond = Piece(slab(1.8, 12, 0, 0, ALL), GROUND)
    pose = Pose.looking((0, 0, 0.95), 0, 25, 0)
    scene = Terrain('', (floor, trench, beyond), (slab(-3, 12, 0, 0, ALL),), pose)
    sensor = SENSORS['realsense'](3)
    frame = simulate_terrain(scene, sensor, seed=3)
    x, y, z = map(float, scene.up)
    config = Config(up_x=x, up_y=y, up_z=z, sensor_height=0.95)
    terrain = Segmenter(config).segment(RangeImage.from_depth(frame.depth, sensor.camera)).terrain
    inside = ~_near_borders(frame.terrain)
    far = inside & (frame.terrain == GROUND) & (frame.depth > 1900) & (frame.depth < 3000)
    assert far.sum() > 20000 and np.mean(terrain[far] == GROUND) > 0.9
    assert np.mean(terrain[inside & (frame.terrain == DROP)] == GROUND) <= 0.01
