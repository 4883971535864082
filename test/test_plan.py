"""From a recording to a plan: every file is opened by what its users would open it with."""

import json
import re
import xml.etree.ElementTree as ET

import cv2
import ezdxf
import numpy as np
import pytest
import shapely
import trimesh
import yaml
from click.testing import CliRunner
from map_squares import plane
from recordings import Recording
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, Transform
from rangeseg_ros.cli.main import rangeseg
from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.core.mapping.plane_grid import PlaneGrid
from rangeseg_ros.io.plans import write_dxf, write_geojson
from rangeseg_ros.plan.flights import Flight, flights
from rangeseg_ros.plan.floor_plan import FREE, FloorPlan, PlanUp, Wall, _openings, estimate_up
from rangeseg_ros.plan.right_angles import square_up
from rangeseg_ros.report.plan import svg
from rangeseg_ros.simulation.scenes import OPTICAL_IN_BODY
from rangeseg_ros.simulation.solids import box, cast, half_space

LEFT, AHEAD, FRAMES = 1.2, 3.0, 12
CAMERA = Camera(160, 120, 110.0, 110.0, 79.5, 59.5)
DOOR = (-1.3, -0.4)
TILT = Rotation.from_euler('xyz', [100, 15, 40], degrees=True)


def room():
    """A floor, a wall ahead with a door in it, a wall on the left, and a box on the floor."""
    middle = AHEAD + 0.1
    return [
        half_space((0, 0, 1), (0, 0, 0)),
        half_space((0, -1, 0), (0, LEFT, 0)),
        box((0.2, 1.6, 2.5), np.eye(3), (middle, 0.4, 1.25)),
        box((0.2, 3.0, 2.5), np.eye(3), (middle, -2.8, 1.25)),
        box((0.3, 0.3, 0.4), np.eye(3), (2.0, 0.5, 0.2)),
    ]


def record(path, tilt):
    """A robot that turns before the door, with the tf of a frame turned by `tilt`, or without."""
    recording, random = Recording(), np.random.default_rng(3)
    for k in range(FRAMES):
        stamp = 10**18 + k * 100_000_000
        body = Rotation.from_euler('zy', [30 - 70 * k / (FRAMES - 1), 15], degrees=True)
        turn = body * Rotation.from_matrix(OPTICAL_IN_BODY)
        place = np.array([0.02 * k, 0.0, 1.1])
        depth, _ = cast(room(), place, turn.apply(CAMERA.rays.reshape(-1, 3)))
        inverse = 1 / depth + random.normal(0, 5e-4, len(depth))
        depth = np.where(inverse > 1 / 6, 1000 / np.maximum(inverse, 1 / 6), 0)
        recording.add_camera(stamp, CAMERA.width, CAMERA.height, k=CAMERA.matrix.ravel())
        recording.add_image(stamp, np.round(depth.reshape(CAMERA.shape)).astype(np.uint16))
        if tilt is None:
            continue
        told, at = tilt * turn, tilt.apply(place)
        for after in (-20_000_000, 20_000_000):
            recording.add_transform(stamp + after, 'odom', 'optical', told.as_quat(), at)
    recording.messages.sort(key=lambda message: message[0])
    recording.write(path)


def run(*words):
    return CliRunner().invoke(rangeseg, list(map(str, words)))


@pytest.fixture(scope='module')
def folders(tmp_path_factory):
    """Plans with up told, in a frame in which nobody says where up is, and without transforms."""
    root = tmp_path_factory.mktemp('plan')
    for name, tilt in (('level', Rotation.identity()), ('tilted', TILT), ('alone', None)):
        gravity = 'odom' if name == 'level' else "''"
        (root / f'{name}.yaml').write_text(f'min_pixels: 150\ngravity_frame: {gravity}\n')
        record(root / f'{name}_bag', tilt)
        words = '--params', root / f'{name}.yaml', '--output', root / name
        result = run('plan', root / f'{name}_bag', *words)
        assert result.exit_code == 0, result.output
    return root


def of_role(folder, role, name='plan.geojson'):
    collection = json.loads((folder / name).read_text())
    return [f for f in collection['features'] if f['properties']['role'] == role]


def shape_of(feature):
    return shapely.from_geojson(json.dumps(feature['geometry']))


@pytest.mark.parametrize('name', ['level', 'tilted', 'alone'])
def test_the_plan_is_that_of_the_room(folders, name):
    folder = folders / name
    (floor,) = of_role(folder, 'floor')
    assert shape_of(floor).is_valid and floor['properties']['exact'] == 'level'
    walls = of_role(folder, 'wall')
    assert len(walls) >= 2 and all(wall['properties']['exact'] == 'square' for wall in walls)
    ahead = max(map(shape_of, walls), key=lambda line: len(shapely.get_parts(line)))
    (opening,) = of_role(folder, 'opening')
    assert opening['properties']['width'] == pytest.approx(DOOR[1] - DOOR[0], abs=0.1)
    assert shape_of(opening).distance(ahead) < 0.01
    if name == 'tilted':
        collection = json.loads((folder / 'plan.geojson').read_text())
        found, truth = np.array(collection['up']['direction']), TILT.apply([0, 0, 1])
        assert np.degrees(np.arccos(min(found @ truth, 1.0))) < 0.5
        matrix = np.array(collection['plan_from_frame'])
        assert np.allclose(matrix[:3, :3] @ found, [0, 0, 1], atol=1e-5)
    if name == 'level':
        assert floor['properties']['distance'] == pytest.approx(0, abs=0.01)
        (x1, y1), (x2, y2) = opening['geometry']['coordinates']
        assert [x1, x2] == pytest.approx([AHEAD, AHEAD], abs=0.02)
        assert sorted([y1, y2]) == pytest.approx(DOOR, abs=0.06)


def test_nav2_reads_the_map_and_the_picture_shows_its_cells(folders):
    about = yaml.safe_load((folders / 'level/map.yaml').read_text())
    shades = cv2.imread(str(folders / 'level' / about['image']), cv2.IMREAD_UNCHANGED)[::-1]
    # As map_server does it.
    share = (255 - shades.astype(float)) / 255
    states = np.where(share > about['occupied_thresh'], 'occupied', 'unknown')
    states[share < about['free_thresh']] = 'free'
    assert set(np.unique(shades)) == {0, 205, 254}

    def at(x, y):
        column, row = ((np.array([x, y]) - about['origin'][:2]) / about['resolution']).astype(int)
        return states[row, column]

    assert at(AHEAD, 0.1) == at(AHEAD, -1.8) == at(2.0, 0.5) == 'occupied'
    assert at(2.0, -0.8) == at(AHEAD, -0.85) == at(AHEAD + 0.4, -0.9) == 'free'
    assert at(AHEAD + 1, 0.3) == 'unknown'
    picture, side = ET.parse(folders / 'level/plan.svg').getroot(), about['resolution']
    left, top, wide, high = map(float, picture.get('viewBox').split())
    for axes, first, length in (('x', left, wide), ('y', top, high)):
        names = axes, f'{axes}1', f'{axes}2'
        places = [float(shape.get(n)) for shape in picture.iter() for n in names if shape.get(n)]
        assert first <= min(places) and max(places) <= first + length
    legend = [text.text for text in picture.iterfind('.//{*}g[@id="legend"]/{*}text')]
    assert legend[1:] == ['to 2 mm', 'to 5 mm', 'to 10 mm', 'to 20 mm', 'more']
    for name, shade in (('free', 254), ('obstacles', 0)):
        shown = np.zeros(shades.shape, bool)
        for rect in picture.find(f'{{*}}g[@id="{name}"]'):
            x, y, width = (float(rect.get(key)) for key in ('x', 'y', 'width'))
            column, row = np.rint((np.array([x, -y]) - about['origin'][:2]) / side).astype(int)
            shown[row - 1, column : column + round(width / side)] = True
        np.testing.assert_array_equal(shown, shades == shade)


def test_other_programs_open_the_files(folders):
    folder = folders / 'level'
    document = ezdxf.readfile(folder / 'plan.dxf')
    assert not document.audit().errors and document.units == ezdxf.units.M
    layers = {entity.dxf.layer for entity in document.modelspace()}
    assert {'WALLS', 'OPENINGS', 'FLOOR', 'PLANES'} <= layers
    walls = document.modelspace().query('LINE[layer=="WALLS"]')
    assert any(abs(w.dxf.start.x - AHEAD) < 0.02 > abs(w.dxf.end.x - AHEAD) for w in walls)
    texts = [text.dxf.text for text in document.modelspace().query('TEXT[layer=="TEXT"]')]
    told = {text.partition(':')[0] for text in texts if re.fullmatch(r'\d+: \+-\d\.\d mm', text)}
    assert told == {str(wall['properties']['id']) for wall in of_role(folder, 'wall')}
    features = json.loads((folder / 'plan.geojson').read_text())['features']
    planes = [f['properties'] for f in features if 'parts' in f['properties']]
    parts = sum(len(part) for plane in planes for part in plane['parts'])
    assert len(document.modelspace().query('POLYLINE[layer=="PLANES"]')) == parts
    area = sum(plane['area'] for plane in planes)
    for name, up in (('map.ply', 2), ('map.glb', 1)):
        scene = trimesh.load_scene(folder / name)
        assert scene.area == pytest.approx(area, rel=0.02) and np.ptp(scene.bounds[:, up]) < 3
    picture = ET.parse(folder / 'plan.svg').getroot()
    titles = [e.text for e in picture.iter('{http://www.w3.org/2000/svg}title')]
    assert sum('standard deviation' in title for title in titles) >= len(walls)
    page = (folder / 'plan.html').read_text()
    assert 'src="http' not in page and '<svg' in page and 'square' in page


def test_files_of_others_are_kept_and_what_lacks_is_said(folders, tmp_path, refused):
    bag, out = folders / 'level_bag', tmp_path / 'out'
    assert 'plan.svg' in refused('plan', bag, '--output', folders / 'level')
    assert 'nowhere' in refused('plan', bag, '--output', out, '--fixed-frame', 'nowhere')
    assert not out.exists()
    assert run('plan', bag, '--output', folders / 'level', '--overwrite').exit_code == 0


def turned(degrees):
    return np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.002


def test_right_angles_are_exact_only_where_the_covariance_allows_it():
    one = np.radians(0.3)
    walls = [
        plane(1, turned(20.1), (3, 1, 1), one, 3.0),
        plane(2, turned(109.7), (0, 3, 1), one),
        plane(3, turned(25.0), (-2, 0, 1), one),
        plane(4, turned(24.0), (-3, 0, 1), 10 * one),
    ]
    squared = square_up(walls, block_diag(*(w.covariance for w in walls)), np.radians(10))
    assert [s.exact for s in squared] == ['square', 'square', 'plumb', 'square']
    assert abs(squared[0].normal @ squared[1].normal) < 1e-12
    assert abs(np.cross(squared[0].normal, squared[3].normal)).max() < 1e-12
    assert squared[0].normal[:2] == pytest.approx(turned(19.9)[:2], abs=1e-3)
    assert all(s.turned < np.radians(5) and abs(s.normal[2]) < 1e-12 for s in squared)
    for before, after in zip(walls, squared, strict=True):
        # It turns about where it is known best, and the outline lies on it.
        assert after.normal @ before.centroid + after.distance == pytest.approx(0, abs=1e-3)
        assert np.allclose(after.outline.hull @ after.normal, -after.distance, atol=1e-9)


def test_up_is_the_least_squares_of_level_and_upright_planes():
    """Of a floor that leans to a wall, or of a ceiling alone; a smaller ramp says nothing."""
    sigma, lean, steep = np.radians([0.5, 2, 40])
    leaning = (0, np.sin(lean), np.cos(lean)), (1, 0, 0), (0, 1, 0), (-1, 0, 0)
    for turn in Rotation.random(8, random_state=5):
        for normals, angle, deviation in (
            (leaning, lean / 2, sigma),
            ([(0, 0, -1)], 0, np.sqrt(2) * sigma),
        ):
            ramp = turn.apply([0, np.sin(steep), np.cos(steep)])
            planes = [plane(9, ramp, turn.apply([0.5, 9, 1]), sigma, size=1)]
            for k, normal in enumerate(normals):
                planes.append(plane(k, turn.apply(normal), turn.apply([0.5, k, 1]), sigma))
            up = estimate_up(planes, turn.apply([0.3, 0.2, 1]), np.radians(10))
            expected = turn.apply([0, np.sin(angle), np.cos(angle)])
            np.testing.assert_allclose(up.direction, expected, atol=1e-9)
            assert up.deviation == pytest.approx(deviation, rel=1e-3)


def test_up_is_as_good_as_unknown_where_nothing_tells_it():
    # The wall that is known best turns up away from the other planes, and is left alone.
    normals = (1, 0, 0.1754), (1, 1, -0.2468), (-1, 1, 0.2063), (0, 0, 1)
    planes = [plane(k, n, (0, 0, 0), (0.001, 0.1, 0.1, 1)[k]) for k, n in enumerate(normals)]
    untold = 'planes that do not tell it'
    cases = ([], 10, 'the images'), (planes, 10, untold), (planes, 0, untold)
    for some, degrees, source in cases:
        up = estimate_up(some, np.array([0, 0, 2.0]), np.radians(degrees))
        assert (up.deviation, up.source) == (np.pi / 4, source)
        assert up.direction.tolist() == [0, 0, 1]


def sighted(edge, direction, pose, random, count):
    """Stairs at an edge (2, 3) as a camera sees them: a part of it, its ends in any order."""
    left, right = sorted(random.uniform(0, 1, 2) * (0.1, 0.1) + (0, 0.9))
    ends = edge[0] + np.outer([left, right], edge[1] - edge[0])
    ends = ends[:: random.choice([-1, 1])] + random.normal(0, 0.01, (2, 3))
    return Stairs(pose.inverse().apply(ends), 1.2, count, 0.17, 0.28, direction), pose


def test_openings_are_wide_and_the_ground_was_seen_in_them():
    """Gaps along x of which one is narrower than two cells, and of one half was not seen."""
    grid = PlaneGrid(0.1)
    grid.extend_to(np.array([(0, 0), (4, 0)]))
    free = np.full(grid.odds.shape, FREE)
    free[:, 25:] = FREE + 1
    places = np.array([(0, 1), (1.15, 1.5), (2, 2.25), (2.85, 4)])
    wall = Wall(7, np.stack([places, np.full_like(places, 0.05)], axis=-1))
    (opening,) = _openings(wall, free, grid)
    assert opening.plane == 7 and opening.ends[:, 0].tolist() == [1.5, 2]


def test_stairs_of_several_frames_are_one_flight():
    random, seen = np.random.default_rng(1), []
    up = np.array([[-2.0, -5.6, 0.0], [-2.0, -4.4, 0.0]])
    down = np.array([[-5.0, -2.0, 0.0], [-6.2, -2.0, 0.0]])
    for k in range(9):
        turn = Rotation.from_euler('zyx', random.uniform(-30, 30, 3), degrees=True).as_matrix()
        pose = Transform(turn, np.array([0.1 * k - 5, 0.05 * k - 5, 1.0]))
        seen.append(sighted(up, 'up', pose, random, 2 + k % 3))
        seen.append(sighted(down, 'down', pose, random, 3))
        if k < 2:  # too few to be sure
            seen.append(sighted(up + np.array([3, 0, 0]), 'up', pose, random, 3))
    first, second = flights(seen)
    assert (first.direction, second.direction) == ('up', 'down')
    assert str(first) == 'stairs up, 4 x 0.17 / 0.28 m'
    # Upwards along x, and downwards along y, away from the camera.
    for flight, axis, count in ((first, 0, 5), (second, 1, 4)):
        places = flight.edges[:, :, axis].mean(axis=1)
        np.testing.assert_allclose(places, -2 + 0.28 * np.arange(count), atol=0.02)
    np.testing.assert_allclose(np.ptp(first.edges[:, :, 1], axis=1), 1.2, atol=0.15)
    assert flights([]) == []


def test_stairs_are_in_every_drawing(tmp_path):
    edges = np.array([[[1.0, 0, 0], [1, 1, 0]], [[1.28, 0, 0], [1.28, 1, 0]]])[..., :2]
    up, cells = PlanUp(np.array([0.0, 0, 1]), 0.0, 'test'), np.zeros((20, 20), np.int8)
    flight, still = Flight(edges, 0.17, 0.28, 'up'), Transform.identity()
    plan = FloorPlan('map', still, up, 0.0, [], [], [], [flight], cells, (0.0, 0.0), 0.1)
    write_dxf(tmp_path / 'a.dxf', plan)
    lines = ezdxf.readfile(tmp_path / 'a.dxf').modelspace().query('LINE[layer=="STAIRS"]')
    assert [line.dxf.start.x for line in lines] == [1.0, 1.28]
    write_geojson(tmp_path / 'a.geojson', plan)
    (stairs,) = of_role(tmp_path, 'stairs', 'a.geojson')
    assert stairs['geometry']['coordinates'] == edges.tolist()
    assert stairs['properties']['treads'] == 1 and stairs['properties']['direction'] == 'up'
    group = ET.fromstring(svg(plan)).find("{*}g[@class='stairs']")
    assert group.find('{*}title').text == str(flight)
    drawn = [(line.get('x1'), line.get('y2')) for line in group.findall('{*}line')]
    assert drawn == [('1.0', '-1.0'), ('1.28', '-1.0')]
