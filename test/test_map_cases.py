"""The map of planes where things are not as they should be: stamps, sizes, cameras, hours."""

import pickle

import numpy as np
import pytest
import shapely
from planes_of_labels import fit_planes
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.plane_grid import HIT, MISS, PlaneGrid
from rangeseg_ros.core.mapping.plane_map import PlaneMap
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import Pose, Scene, kinect_room, walk
from rangeseg_ros.simulation.sensors.kinect import kinect_camera
from rangeseg_ros.simulation.solids import box, half_space

CONFIG = Config(min_pixels=150)
ROOM = kinect_room(4)
SCENE = Scene(ROOM.solids, walk(ROOM.poses[0], 4, 40), ROOM.dark)


def seen(k, width=320, sensor=0):
    """Image and pose of frame `k` of a walk."""
    camera = kinect_camera(width, width * 3 // 4)
    view = simulate_kinect(SCENE, camera, frame=k, sensor_seed=sensor)
    pose = SCENE.poses[k]
    return RangeImage.from_depth(view.depth, view.camera), Transform(pose.rotation, pose.position)


def test_frames_without_stamps_make_a_map():
    sequence, areas = SequenceSegmenter(CONFIG), []
    for k, times in ((0, 3), (36, 17)):
        image, pose = seen(k)
        for _ in range(times):
            sequence.segment(image, 0, pose=pose)
        areas.append(sum(plane.area for plane in sequence.map.planes))
    assert len(sequence.map) > 3
    assert {plane.last_stamp for plane in sequence.map.planes} == {0}
    assert sequence.map.begun_anew == ''
    # Outlines grow all the same.
    assert areas[1] > 1.02 * areas[0]


def test_another_size_of_images_goes_on_with_the_map():
    sequence = SequenceSegmenter(CONFIG)
    sizes, ids = [], []
    for n, k in enumerate(range(0, 40, 4)):
        image, pose = seen(k, 320 if n < 5 else 240)
        sequence.segment(image, 10**9 + k * 10**9 // 30, pose=pose)
        sizes.append(len(sequence.map))
        ids.append({plane.id for plane in sequence.map.planes})
    assert sizes[4] > 3
    assert sizes[4] - 1 <= sizes[-1] <= sizes[4] + 3
    assert len(ids[4] & ids[-1]) >= sizes[4] - 1


def test_parameters_changed_while_running_keep_the_map():
    sequence = SequenceSegmenter(CONFIG)
    for n, k in enumerate(range(0, 40, 4)):
        if n == 5:
            before = {plane.id for plane in sequence.map.planes}
            sequence.config = Config(min_pixels=300, map_resolution=0.1, distortion_length=20.0)
        image, pose = seen(k)
        sequence.segment(image, 10**9 + k * 10**9 // 30, pose=pose)
    after = {plane.id for plane in sequence.map.planes}
    assert len(before) > 3 and len(before & after) >= len(before) - 1
    assert sequence.map.begun_anew == ''
    # Another frame is another map.
    sequence.config = Config(min_pixels=300, fixed_frame='odom')
    assert len(sequence.map) == 0 and sequence.map.begun_anew == 'its frame has changed'


@pytest.mark.parametrize('kind', ['returns', 'goes on'])
def test_memory_is_bounded_however_long_one_walks(kind):
    camera, random = kinect_camera(80, 60), np.random.default_rng(0)
    solids = [half_space((0, 0, 1), (0, 0, 0)), half_space((0, 1, 0), (0, -1.6, 0))]
    solids += [box((0.6, 0.4, 0.7), np.eye(3), (x, 0.9, 0.35)) for x in (3.0, 5.0, 7.0)]
    along = np.concatenate([np.linspace(0, 4, 12), np.linspace(4, 0, 12)])
    poses = [Pose.looking((x, 0, 1.2), 12 * np.sin(x), 22, 0) for x in along]
    frames = []
    for pose in poses:
        view = simulate_kinect(Scene(tuple(solids), (pose,)), camera)
        image = RangeImage.from_depth(view.depth, camera)
        planes = fit_planes(view.labels, image, SensorModel.from_config(CONFIG))
        frames.append((view.labels, [p for p in planes if p.count > 40], image))
    plane_map, kept, sizes = PlaneMap(Config(map_planes=12)), [], []
    for n in range(9 * len(frames)):
        (labels, planes, image), pose = frames[n % len(frames)], poses[n % len(frames)]
        # Where it goes on, each round is past the next three of a row of boxes.
        shift = pose.position + random.normal(0, 0.005, 3)
        shift[0] += 6 * (n // len(frames)) * (kind == 'goes on')
        plane_map.add(labels, planes, image, Transform(pose.rotation, shift), (n + 1) * 10**8)
        kept.append(len(plane_map))
        if n % len(frames) == len(frames) - 1:
            sizes.append(len(pickle.dumps(plane_map)))
    assert kept[-1] > 5 and max(kept) <= 12
    assert max(kept) > 9 or kind == 'returns'
    # All that it holds; grids on planes that go on grow up to their bound.
    assert max(sizes[6:]) < 1.1 * max(sizes[3:6]) or kind == 'goes on'


def test_a_grid_is_bounded_however_far_a_plane_goes():
    grid = PlaneGrid(0.03)
    for x in range(60):
        found = grid.fill([[np.array([[x, 0], [x + 1.2, 0], [x + 1.2, 40], [x, 40.0]])]])
        grid.add(found, HIT)
    assert grid.odds.size <= 2**18 and grid.side == 0.12
    assert grid.area == pytest.approx(60.2 * 40, rel=0.01)


def test_a_grid_has_the_area_and_the_outline_of_what_was_seen():
    grid, turn = PlaneGrid(0.02), Rotation.from_rotvec([0, 0, 0.6]).as_matrix()[:2, :2]
    square = np.array([[0, 0], [2, 0], [2, 1], [0, 1.0]])
    hole = np.array([[0.5, 0.3], [0.5, 0.7], [1.0, 0.7], [1.0, 0.3]])
    apart = square * 0.2 + (0, 1.5)
    for _ in range(3):
        grid.add(grid.fill([[square @ turn.T, hole @ turn.T], [apart @ turn.T]]), HIT)
    truth, border = 2 - 0.2 + 0.08, 6 + 1.8 + 1.2
    # A quarter of a cell along the borders.
    assert grid.area == grid.sure_area == pytest.approx(truth, abs=0.25 * grid.side * border)
    (border, inner), (other,) = grid.polygons()
    areas = [shapely.LinearRing(ring).is_ccw for ring in (border, inner, other)]
    assert areas == [True, False, True]
    found = shapely.Polygon(border, [inner]).union(shapely.Polygon(other))
    wanted = shapely.Polygon(square @ turn.T, [hole @ turn.T]).union(
        shapely.Polygon(apart @ turn.T)
    )
    assert found.symmetric_difference(wanted).area < 0.05 * truth
    # What is looked at in vain is gone after as many looks as it was sure.
    for _ in range(7):
        grid.add(grid.odds > 0, MISS)
    assert grid.area == 0 and grid.polygons() == []


def test_a_sliver_between_cells_is_seen():
    grid = PlaneGrid(0.1)
    grid.add(grid.fill([[np.array([[0.01, 0.02], [0.05, 0.02], [0.05, 0.03]])]]), HIT)
    assert grid.area == pytest.approx(0.01)
    assert grid.distance(np.array([0.03, 0.02])) == 0
    assert grid.distance(np.array([0.05, 1.05])) == pytest.approx(1.0)
