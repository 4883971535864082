"""The map of planes: estimates against truth, growth, what is gone, what is one."""

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from map_squares import observed
from planes_of_labels import fit_planes
from scipy.spatial.transform import Rotation

from rangeseg_ros import Config, RangeImage, Transform
from rangeseg_ros.core.mapping.observations import PoseNoise, observations
from rangeseg_ros.core.mapping.plane_filter import PlaneFilters
from rangeseg_ros.core.mapping.plane_grid import PlaneGrid
from rangeseg_ros.core.mapping.plane_map import PlaneMap
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.sequence import SequenceSegmenter, with_roles
from rangeseg_ros.core.significance import HIT, MISS
from rangeseg_ros.plan.floor_plan import deviation_of
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import Pose, Scene, kinect_room, walk
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera
from rangeseg_ros.simulation.solids import box, half_space

CAMERA = kinect_camera(160, 120)
SENSOR = SensorModel.from_config(Config())
NOISE = PoseNoise(0.005, np.radians(0.3))
CONFIG = Config(min_pixels=150)


@pytest.mark.parametrize('pattern', ['stays', 'changes'])
def test_the_filter_knows_how_far_it_is_off(pattern):
    random = np.random.default_rng(0)
    truth = np.array([0, 0, 1, 0.0])
    values, errors = [], []
    for _ in range(60):
        root = 0.004 * random.standard_normal((3, 3))
        lasting, filters = random.standard_normal(3), None
        for k in range(15):
            turn = Rotation.from_rotvec(random.normal(0, 0.1, 3))
            turn *= Rotation.from_euler('x', -120, degrees=True)
            pose = Transform(turn.as_matrix(), np.array([random.uniform(-1, 1), -1, 1.2]))
            if pattern == 'changes':
                lasting = random.standard_normal(3)
            plane = observed(random, truth, pose, root, lasting)
            told = pose.by(random.normal(0, NOISE.deviations))
            view = np.eye(15)[[k if pattern == 'changes' else 0]]
            seen = observations([plane], view, told, NOISE)
            filters = filters or PlaneFilters.of(seen)
            filters.update(np.array([0]), seen)
        error = filters.planes.equations[0] - truth
        covariance = filters.planes.covariances(filters.covariance)[0]
        values.append(error @ np.linalg.pinv(covariance, 1e-10) @ error / 3)
        errors.append(np.linalg.norm(error[:3]))
    assert 0.7 < np.mean(values) < 1.4 and np.median(errors) < np.radians(0.4)


def image_and_truth(scene, k=0, seed=0, camera=CAMERA):
    """Image, true labels and faces of a frame."""
    view = simulate(scene, Kinect(0), camera, frame=k, seed=seed)
    return RangeImage.from_depth(view.depth, camera), view


def pose_of(pose):
    return Transform(pose.rotation, pose.position)


def add(plane_map, scene, k, random):
    """Take in the true regions of a frame, with noise on the pose."""
    image, view = image_and_truth(scene, k, len(scene.solids))
    planes = with_roles(fit_planes(view.labels, image, SENSOR), Config(), (0, -1, 0))
    # Regions of one frame are not followed to the next: no ids are alike.
    planes = [replace(p, id=1000 * (k + 1) + p.label) for p in planes if p.count > 100]
    told = pose_of(scene.poses[k]).by(random.normal(0, NOISE.deviations))
    plane_map.add(view.labels, planes, image, told, 10**9 + k * 10**9 // 30)


def on_face(plane, truth):
    return truth[:3] @ plane.normal > 0.98 and abs(truth[:3] @ plane.centroid + truth[3]) < 0.05


@pytest.mark.parametrize('seed', [3, 8])
def test_a_walk_maps_every_face_once_and_better_than_single_frames(seed):
    scene = kinect_room(seed, 150, walk)
    plane_map, random = PlaneMap(), np.random.default_rng(0)
    for k in range(0, 150, 5):
        add(plane_map, scene, k, random)
    planes, truth = plane_map.planes, np.vstack([solid.planes for solid in scene.solids])
    # Floor and walls are there, and nothing else is where they are.
    for face in truth[:3]:
        (plane,) = (plane for plane in planes if on_face(plane, face))
        assert np.degrees(np.arccos(min(1, plane.normal @ face[:3]))) < 1.5
        assert abs(face[:3] @ plane.centroid + face[3]) < 0.03
        assert plane.observations >= 20 and plane.area > 1
    assert min(sum(on_face(plane, face) for face in truth) for plane in planes) == 1
    ids = [plane.id for plane in planes]
    assert ids == sorted(set(ids)) and {'wall', 'floor'} & {plane.role for plane in planes}
    for plane in planes:
        assert plane.first_stamp <= plane.last_stamp
        assert plane.age == pytest.approx((plane.last_stamp - plane.first_stamp) * 1e-9)
        assert plane.covariance == pytest.approx(plane.covariance.T)
        for ring in (plane.hull, *plane.holes):
            np.testing.assert_allclose(ring @ plane.normal + plane.distance, 0, atol=1e-6)


def test_parts_that_turn_out_to_be_one_surface_become_one_plane():
    pose = Pose.looking((0, 0, 1.2), 0, 0, 0)
    image, view = image_and_truth(Scene((half_space((-1, 0, 0), (2.5, 0, 0)),), (pose,)))
    labels = view.labels.copy()
    labels[:, 80:] *= 2
    labels[:, 76:84] = 0
    parts, plane_map, counts = fit_planes(labels, image, SENSOR), PlaneMap(), []
    for k in range(8):
        named = ((part, part.label if k < 4 else 1) for part in parts[: k + 1])
        planes = [replace(part, id=10 * k + part.label, surface=own) for part, own in named]
        plane_map.add(labels, planes, image, pose_of(pose), 10**9 + k * 10**8)
        counts.append(len(plane_map))
    # Not what a frame finds on two surfaces, though the second one is new.
    assert counts[3] == 2
    (wall,) = plane_map.planes
    assert wall.observations == 2 * 8 - 1 and plane_map.successors == {wall.id + 1: wall.id}
    assert wall.area == pytest.approx(sum(plane.area for plane in parts), rel=0.15)


def test_what_rays_pass_through_is_gone_within_seconds():
    pose = Pose.looking((0, 0, 1.2), 0, 20, 0)
    room = (half_space((0, 0, 1), (0, 0, 0)), half_space((-1, 0, 0), (3.5, 0, 0)))
    cube = box((0.5, 0.5, 0.8), np.eye(3), (2.0, 0, 0.4))
    before, after = Scene((*room, cube), (pose,) * 40), Scene(room, (pose,) * 40)
    random, plane_map = np.random.default_rng(0), PlaneMap()
    for k in range(12):
        add(plane_map, before, k, random)
    front, count = np.array([-1, 0, 0, 1.75]), len(plane_map)
    assert sum(on_face(plane, front) for plane in plane_map.planes) == 1
    for k in range(12, 32):
        add(plane_map, after, k, random)
    assert not any(on_face(plane, front) for plane in plane_map.planes)
    assert len(plane_map) == count - 2  # front and top
    # The floor behind it is filled in.
    floor = next(plane for plane in plane_map.planes if on_face(plane, (0, 0, 1, 0)))
    assert shapely.Polygon(floor.hull[:, :2]).contains(shapely.Point(2.3, 0))


SCENE, IDENTITY = kinect_room(4, 48, walk), Transform.identity()


def show(sequence, k, stamp, width=320, fixed=IDENTITY):
    """Segment frame `k` of a walk, the fixed frame moved; the ids of the planes of the map."""
    image, _ = image_and_truth(SCENE, k, camera=kinect_camera(width, width * 3 // 4))
    sequence.segment(image, stamp, pose=fixed.after(pose_of(SCENE.poses[k])))
    return {plane.id for plane in sequence.map.planes}


@pytest.mark.parametrize('turn', [0.0, 25.0])
def test_the_map_follows_a_jump_of_the_fixed_frame(turn):
    # Odometry never jumps, but poses do that come beside it.
    config = replace(CONFIG, odometry=turn > 0, fixed_frame='map')
    sequence, sizes = SequenceSegmenter(config), []
    turned = Rotation.from_euler('z', turn, degrees=True).as_matrix()
    jump = Transform(turned, np.array([0.6, -0.5, 0.0]))
    for k in range(0, 48, 4):
        ids = show(sequence, k, 10**9 + k * 10**9 // 30, fixed=jump if k >= 24 else IDENTITY)
        sizes.append(len(ids))
        if k == 20:
            before = {plane.id: plane for plane in sequence.map.planes}
    assert sizes[5] > 3 and sizes[5] <= sizes[-1] <= sizes[5] + 2
    ((stamp, _),) = sequence.map.jumps
    assert stamp == 10**9 + 24 * 10**9 // 30
    after = {plane.id: plane for plane in sequence.map.planes}
    assert before.keys() <= after.keys()
    for number, plane in before.items():
        normal = jump.rotation @ plane.normal
        offset = normal @ (after[number].centroid - jump.shift) + plane.distance
        assert np.degrees(np.arccos(min(1, normal @ after[number].normal))) < 1.5
        assert abs(offset) < 0.03
    # What the jump errs by, all of them do: the one that was known best is known worse.
    best = min(before.values(), key=deviation_of)
    assert deviation_of(after[best.id]) > deviation_of(best)


def test_a_tread_that_is_taken_for_the_next_is_no_jump():
    sizes = [((0.28, 3, 0.17 * k), (1.4 + 0.28 * k, 0, 0.085 * k)) for k in (1, 2, 3, 4)]
    treads = [box(size, np.eye(3), at) for size, at in sizes]
    pose = Pose.looking((0, 0, 1.5), 0, 32, 0)
    scene = Scene((half_space((0, 0, 1), (0, 0, 0)), *treads), (pose,) * 8)
    plane_map = PlaneMap()
    for k in range(8):
        image, view = image_and_truth(scene, k, 1)
        face = {plane.label: plane.face for plane in view.planes}
        planes = fit_planes(view.labels, image, SENSOR)
        # In the last frame all that is level has the id of what was one step higher.
        level = [p for p in planes if p.normal @ pose.rotation[2] > 0.9]
        level.sort(key=lambda p: p.centroid @ pose.rotation[2])
        assert len(level) > 3
        ids = {p.label: face[p.label] + 1 for p in planes}
        if k == 7:
            ids |= {p.label: face[q.label] + 1 for p, q in pairwise(level)} | {level[-1].label: 99}
        named = [replace(p, id=ids[p.label]) for p in planes]
        plane_map.add(view.labels, named, image, pose_of(pose), 10**9 + k * 10**9 // 30)
    assert plane_map.jumps == plane_map.doubts == []
    plane_map.jumps += [(10**9, 'off')] * 12
    more = '2 more frames whose poses the planes contradict'
    assert plane_map.doubts == ['1.000 s: off'] * 10 + [more]
    heights = sorted(plane.centroid[2] for plane in plane_map.planes if plane.normal[2] > 0.9)
    np.testing.assert_allclose(heights[:4], 0.17 * np.arange(4), atol=0.03)


def test_a_looped_recording_begins_the_map_anew():
    sequence = SequenceSegmenter(CONFIG)
    ids = [show(sequence, 0, 10**9 + k % 4 * 10**8) for k in range(8)]
    assert len(ids[3]) == len(ids[7]) > 3 and not ids[3] & ids[7]
    assert sequence.map.begun_anew == 'time has gone back'


def test_frames_without_stamps_make_a_map():
    sequence, areas = SequenceSegmenter(CONFIG), []
    for k, times in ((0, 3), (36, 17)):
        for _ in range(times):
            show(sequence, k, 0)
        areas.append(sum(plane.area for plane in sequence.map.planes))
    assert len(sequence.map) > 3 and {plane.last_stamp for plane in sequence.map.planes} == {0}
    assert sequence.map.begun_anew == ''
    # Outlines grow all the same.
    assert areas[1] > 1.02 * areas[0]


def test_another_size_of_images_and_parameters_changed_while_running_keep_the_map():
    sequence, ids = SequenceSegmenter(CONFIG), []
    for n, k in enumerate(range(0, 40, 4)):
        if n == 5:
            sequence.config = Config(min_pixels=200, map_resolution=0.1, distortion_length=20.0)
        ids.append(show(sequence, k, 10**9 + k * 10**9 // 30, 320 if n < 5 else 240))
    assert 3 < len(ids[4]) <= len(ids[4] & ids[-1]) + 1 and len(ids[-1]) <= len(ids[4]) + 3
    assert sequence.map.begun_anew == ''
    # Another frame is another map.
    sequence.config = Config(fixed_frame='odom')
    assert len(sequence.map) == 0 and sequence.map.begun_anew == 'its frame has changed'


def test_of_too_many_planes_those_out_of_sight_the_longest_are_forgotten():
    """Two walls side by side, 10 m farther every time; of those seen last alike, the seldom."""
    labels = np.ones(CAMERA.shape, np.uint16)
    labels[:, 80:] = 2
    image = RangeImage.from_depth(1.0 + labels, CAMERA)
    walls = fit_planes(labels, image, SENSOR)
    plane_map, kept, sizes = PlaneMap(Config(map_planes=3)), [], []

    def visit(place, planes):
        planes = [replace(plane, id=10 * place + plane.label) for plane in planes]
        pose = Transform(np.eye(3), np.array([0, 0, 10.0 * place]))
        plane_map.add(labels, planes, image, pose, 0)

    for _ in range(8):
        visit(0, walls[1:])  # once oftener than the other one
        for place in range(3):
            for _ in range(3):
                visit(place, walls)
            kept.append(sorted(round(plane.distance) for plane in plane_map.planes))
        sizes.append(len(pickle.dumps(plane_map)))
    assert kept[:3] == [[2, 3], [3, 12, 13], [12, 22, 23]]
    # All that it holds.
    assert max(sizes) < 1.02 * sizes[1]


def test_a_grid_is_bounded_however_far_a_plane_goes():
    grid = PlaneGrid(0.03)
    for x in range(60):
        grid.add(grid.fill([[np.array([[x, 0], [x + 1.2, 0], [x + 1.2, 40], [x, 40.0]])]]), HIT)
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
    rings = border, inner, other
    assert [shapely.LinearRing(ring).is_ccw for ring in rings] == [True, False, True]
    border, inner, other = (ring @ turn for ring in rings)
    found = shapely.Polygon(border, [inner]).union(shapely.Polygon(other))
    wanted = shapely.Polygon(square, [hole]).union(shapely.Polygon(apart))
    assert found.symmetric_difference(wanted).area < 0.05 * truth
    # What is looked at in vain is gone after as many looks as it was sure.
    for _ in range(7):
        grid.add(grid.odds > 0, MISS)
    assert grid.area == 0 and grid.polygons() == []


def test_a_sliver_between_cells_is_seen():
    grid = PlaneGrid(0.1)
    grid.add(grid.fill([[np.array([[0.01, 0.02], [0.05, 0.02], [0.05, 0.03]])]]), HIT)
    assert grid.area == pytest.approx(0.01) and grid.distance(np.array([0.03, 0.02]), 0.0) == 0


@pytest.mark.parametrize('seed', range(20))
def test_distances_up_to_their_limit_are_those_of_all_cells(seed):
    random = np.random.default_rng(seed)
    grid = PlaneGrid(0.1)
    grid.add(grid.fill([[random.uniform(-1, 1, 2) + np.eye(3)[:, :2]]]), HIT)
    for point in random.uniform(-3, 3, (50, 2)):
        nearest = np.linalg.norm(grid.centres() - point, axis=1).min()
        for limit in nearest * 0.999, nearest, np.inf:
            found = grid.distance(point, limit)
            assert found in (0, pytest.approx(nearest)) or (found == np.inf and limit < nearest)
            assert found > 0 or nearest <= grid.side * 0.5**0.5
