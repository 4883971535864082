"""Simulated scenes: ray casting, truth regions, random rooms, and what the command writes."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from replays import rows_of
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.images import read_depth, read_labels
from rangeseg_ros.simulation import scenes
from rangeseg_ros.simulation.render import NOT_PLANAR, simulate, visible_regions
from rangeseg_ros.simulation.scenes import Pose, Scene, curved_scene
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera
from rangeseg_ros.simulation.sensors.sensor import Ideal
from rangeseg_ros.simulation.sensors.stereo import RealSense
from rangeseg_ros.simulation.solids import box, cast, cylinder, half_space, prism, sphere
from rangeseg_ros.simulation.terrain.frame import LEAST, simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import HARD, KINDS, terrain_scene
from rangeseg_ros.simulation.terrain.scene import Site

ORIGIN = np.zeros(3)
UPRIGHT = np.eye(3)
TRIANGLE = [(-0.5, -0.3), (0.6, -0.3), (0.1, 0.7)]
CAMERA = Camera(80, 60, 72.0, 72.0, 39.5, 29.5)


@pytest.mark.parametrize(
    ('solid', 'direction', 'distance', 'face'),
    [
        (half_space((0, 0, -1), (0, 0, 3)), (0, 0, 1), 3, 0),
        (half_space((0, 0, -1), (0, 0, 3)), (0, 0, 2), 1.5, 0),
        (half_space((0, 0, -1), (0, 0, 3)), (1, 0, 0), np.inf, -1),
        (half_space((0, 0, -1), (0, 0, 3)), (0, 0, -1), np.inf, -1),
        # Faces of a prism: its sides in the order of the outline, then top (+z) and bottom.
        (box((1, 1, 1), UPRIGHT, (0, 0, 3)), (0, 0, 1), 2.5, 5),
        (box((1, 1, 1), UPRIGHT, (3, 0, 0)), (1, 0, 0), 2.5, 3),
        # Exactly along the plane of a side face, beyond it, and just within.
        (box((1, 1, 1), UPRIGHT, (0.6, 0, 3)), (0, 0, 1), np.inf, -1),
        (box((1, 1, 1), UPRIGHT, (0.4, 0, 3)), (0, 0, 1), 2.5, 5),
        (box((1, 1, 1), UPRIGHT, (0, 0, 0)), (0, 0, 1), np.inf, -1),  # entered by none from inside
        (sphere(0.5, (0, 0, 2)), (0, 0, 1), 1.5, 0),
        (sphere(0.5, (0.5 + 1e-9, 0, 2)), (0, 0, 1), np.inf, -1),
        (cylinder(0.5, 1, UPRIGHT, (2, 0, 0)), (1, 0, 0), 1.5, 2),
        (cylinder(0.5, 1, UPRIGHT, (0, 0, 2)), (0, 0, 1), 1.5, 1),  # along its axis
        (cylinder(0.5, 1, UPRIGHT, (0.6, 0, 2)), (0, 0, 1), np.inf, -1),
    ],
)
def test_exact_hits(solid, direction, distance, face):
    reached, hit = cast([solid], ORIGIN, direction)
    assert reached == pytest.approx(distance, abs=1e-12) and hit == face


def values_at(solid, points):
    """p'Qp (..., F) of every face at points (..., 3): below 0 inside."""
    homogeneous = np.insert(points, 3, 1.0, axis=-1)
    return np.einsum('...i,fij,...j->...f', homogeneous, solid.faces, homogeneous)


@given(st.integers(0, 2**32 - 1))
def test_first_hit_is_on_the_face_and_nothing_lies_before_it(seed):
    random = np.random.default_rng(seed)
    turns, places = Rotation.random(3, random).as_matrix(), random.uniform(-2, 2, (4, 3))
    solids = [
        half_space(random.standard_normal(3), 4 * random.standard_normal(3)),
        box(random.uniform(0.2, 2, 3), turns[0], places[0]),
        prism(TRIANGLE, random.uniform(0.2, 2), turns[1], places[1]),
        sphere(random.uniform(0.1, 1), places[2]),
        cylinder(*random.uniform((0.1, 0.2), (1, 2)), turns[2], places[3]),
    ]
    origins, directions = random.uniform(-3, 3, (2, 40, 3))
    distance, face = cast(solids, origins, directions)
    # March up to the hit (or far).
    ways = directions * np.minimum(distance, 5.0)[:, None]
    paths = origins[:, None] + np.linspace(0, 1, 400)[:, None] * ways[:, None]
    first = 0
    for solid in solids:
        inside = (values_at(solid, paths) < -1e-6).all(axis=2)
        begins, own = inside[:, 0], (face >= first) & (face < first + len(solid.faces))
        assert not inside[~begins].any() and not (own & begins).any()
        # What is hit is the border of the solid, from outside of its face.
        values, before = (
            values_at(solid, (origins + reach[:, None] * directions)[own])
            for reach in (distance, distance - 1e-3)
        )
        hit = np.arange(len(values)), face[own] - first
        assert (values < 1e-9).all() and (before[hit] > 0).all()
        assert values[hit] == pytest.approx(0, abs=1e-9)
        first += len(solid.faces)


def test_face_cut_in_two_gives_two_regions_of_one_face():
    face = np.array([[0, 1, 0, 0], [0, 1, 0, -1], [0, 1, 2, 0]], np.int32)
    planes = np.array([[0, 0, -1, 3.0], [0, 0, -1, 2.0], [np.nan] * 4])
    labels, regions = visible_regions(face, planes)
    # The pixel at the lower right touches the middle region only through a corner.
    assert labels.tolist() == [[1, 4, 2, 2], [1, 4, 2, 0], [1, 4, NOT_PLANAR, 3]]
    told = [(r.label, r.face, r.count, r.distance) for r in regions]
    assert told == [(1, 0, 3, 3.0), (2, 0, 3, 3.0), (3, 0, 1, 3.0), (4, 1, 3, 2.0)]


@pytest.mark.parametrize('build', [scenes.kinect_room, scenes.curved_scene])
@pytest.mark.parametrize('sensor', [Kinect(0, 'none'), Ideal(0)])
@pytest.mark.parametrize('seed', range(3))
def test_points_of_a_region_lie_on_its_plane_exactly(build, sensor, seed):
    frame = simulate(build(seed, 30), sensor, kinect_camera(320, 240), frame=29)
    points = frame.depth[..., None].astype(float) * frame.camera.rays
    for plane in frame.planes:
        assert plane.distance > 0 and np.linalg.norm(plane.normal) == pytest.approx(1)
        mask = frame.labels == plane.label
        assert mask.sum() == plane.count
        assert np.abs(points[mask] @ plane.normal + plane.distance).max() < 2e-6
    curved = frame.labels == NOT_PLANAR
    assert curved.mean() > 0.01 if build is scenes.curved_scene else not curved.any()


@pytest.mark.parametrize('kind', [*KINDS, *HARD])
def test_heights_of_every_kind_of_terrain_are_those_of_its_parts(kind):
    """Ground is at 0 but for gaps of 2 mm, objects stand on it, and drops are below it."""
    for seed in range(6):
        frame = simulate_terrain(terrain_scene(kind, seed), Ideal(0), CAMERA, seed)
        top = frame.size + (0.05 if kind == 'overhead' else 0)  # of the middle of a bar
        deepest = -np.inf if kind == 'slope' else -frame.size
        # Under objects waves are not known exactly.
        least = 0.04 if kind == 'waves' else 1e-5
        bounds = {GROUND: (-0.002, 0), OBSTACLE: (0, top), DROP: (deepest, -LEAST)}
        for terrain, (low, high) in bounds.items():
            within = (frame.height > low - least) & (frame.height < high + least)
            assert within[frame.terrain == terrain].all(), (seed, terrain)


def test_rough_ground_has_the_relief_it_says():
    scene = terrain_scene('rough', 0)
    rough, flat = (
        simulate_terrain(made, Ideal(0), CAMERA) for made in (scene, replace(scene, relief=0.0))
    )
    off = (flat.depth - rough.depth) * (CAMERA.rays @ scene.pose.rotation[2])
    assert np.std(off[flat.terrain == GROUND]) == pytest.approx(scene.relief, rel=0.1)


def test_parts_of_a_terrain_are_where_they_say():
    site = Site('', 0)
    site.wall(3.0)
    site.gap(1.0, 0.5)
    site.table(2.0)
    solids = [piece.solid for piece in site.pieces]
    assert cast(solids[:1], (0, 0, 1), (1, 0, 0))[0] == 3
    places, down = np.array([(x, 0, 2) for x in (0.9, 1.25, 1.6)]), (0, 0, -1)
    np.testing.assert_allclose(cast(solids[1:4], places, [down] * 3)[0], [2, 3, 2])
    assert site.pieces[2].terrain == DROP
    # Legs of 5 cm, half of that from the rim.
    places = np.mgrid[1.5:3.5:401j, -1.5:1.5:601j, 9:9:1j].reshape(3, -1).T
    top, legs = (
        places[np.isfinite(cast(part, places, np.full_like(places, down))[0]), :2]
        for part in (solids[4:5], solids[5:])
    )
    for end, inwards in ((np.min, 0.025), (np.max, -0.025)):
        np.testing.assert_allclose(end(legs, axis=0), end(top, axis=0) + inwards, atol=0.006)
    assert len(legs) == pytest.approx(4 * 10 * 10, rel=0.2)


def test_pose_looks_where_it_says():
    pose = Pose.looking((0, 0, 1), yaw=90, pitch=30, roll=0)
    # Optical z: along the world's y, downwards; optical x: to the right of it.
    assert pose.rotation[:, 2] == pytest.approx([0, np.cos(np.pi / 6), -0.5])
    assert pose.rotation[:, 0] == pytest.approx([1, 0, 0])
    # Of a normal of any length.
    floor = Scene((half_space((0, 0, 2), (3, 0, -0.5)),), (pose,))
    assert floor.planes(pose)[0] == pytest.approx([0, -np.cos(np.pi / 6), -0.5, 1.5])


SMALL = ['--width', '160', '--height', '120']


@pytest.fixture
def simulated(run, tmp_path):
    """Simulate by the command into a folder."""

    def simulated(*words):
        code, _, error = run('simulate', *words, *SMALL, '--output', tmp_path / 'rooms')
        assert code == 0, error
        return tmp_path / 'rooms'

    return simulated


def test_kinect_folder_holds_the_scenes(tmp_path, simulated):
    words = '--scenes', 2, '--frames', 2, '--seed', 7, '--scene', 'curved', '--sensor-seed', 3
    output = simulated('kinect', *words)
    assert [path.name for path in tmp_path.iterdir()] == ['rooms']
    names = ['000007_000000', '000007_000001', '000008_000000', '000008_000001']
    for kind in ('depth', 'truth'):
        assert sorted(path.stem for path in (output / kind).iterdir()) == names

    expected = simulate(curved_scene(8, 2), Kinect(3), kinect_camera(160, 120), frame=1, seed=8)
    assert read_camera(output / 'camera.yaml') == expected.camera
    assert np.array_equal(read_depth(output / 'depth' / f'{names[3]}.png'), expected.depth)
    truth = read_labels(output / 'truth' / f'{names[3]}.png')
    assert np.array_equal(truth, expected.labels)

    rows = [row for row in rows_of(output / 'planes.csv') if row.pop('image') == names[3]]
    for row, plane in zip(rows, expected.planes, strict=True):
        told = plane.label, plane.face, *plane.normal, plane.distance, (truth == plane.label).sum()
        assert [float(value) for value in row.values()] == pytest.approx(told, abs=1e-8)
        assert [*row][2:] == ['normal_x', 'normal_y', 'normal_z', 'distance', 'count']

    with DepthBag(output / 'bag') as bag:
        first, _, _, last = bag
    assert np.array_equal(last.depth, expected.depth) and last.stamp - first.stamp == 100_000_000


def test_without_noise_the_bag_has_exact_metres(simulated):
    with DepthBag(simulated('kinect', '--scenes', 1, '--noise', 'none') / 'bag') as bag:
        (frame,) = bag
    expected = simulate(scenes.kinect_room(0), Kinect(0, 'none'), kinect_camera(160, 120))
    np.testing.assert_array_equal(frame.depth, expected.depth)


def test_nothing_is_overwritten_or_left_half_written(tmp_path, monkeypatch, refused):
    (tmp_path / 'rooms').mkdir()
    (tmp_path / 'rooms/precious').touch()
    assert 'exists already' in refused('simulate', 'kinect', '--output', tmp_path / 'rooms')

    full = mock.Mock(side_effect=OSError('disk full'))
    monkeypatch.setattr('rangeseg_ros.cli.simulate.write_image', full)
    words = 'simulate', 'kinect', '--scenes', 1, *SMALL, '--output', tmp_path / 'other'
    assert 'disk full' in refused(*words)
    assert [path.name for path in tmp_path.iterdir()] == ['rooms']


@pytest.mark.parametrize(
    ('option', 'value'),
    [('--noise', 'loud'), ('--scenes', 0), ('--seed', -1), ('--width', 1), ('--scene', 'desert')],
)
def test_bad_option(tmp_path, option, value, refused):
    error = refused('simulate', 'kinect', option, value, '--output', tmp_path / 'rooms')
    assert option in error and str(value) in error and not any(tmp_path.iterdir())


def test_terrain_is_seen_by_an_image_of_any_size(simulated):
    words = '--sensor', 'realsense', '--scenes', 1, '--seed', 5, '--kind', 'curb'
    output = simulated('terrain', *words)
    # 90 degrees wide, as the sensor's own images.
    camera = Camera(160, 120, 80.0, 80.0, 79.5, 59.5)
    assert read_camera(output / 'camera.yaml') == camera
    expected = simulate_terrain(terrain_scene('curb', 5), RealSense(5), camera, seed=5)
    assert np.array_equal(read_depth(output / 'depth' / '000005.png'), expected.depth)
    assert np.array_equal(read_labels(output / 'truth' / '000005.png'), expected.terrain)
