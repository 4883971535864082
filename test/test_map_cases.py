"""The map of planes where things are not as they should be: stamps, sizes, cameras, hours."""

import pickle

import numpy as np
import pytest
import shapely
from planes_of_labels import fit_planes

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.evidence import Evidence
from rangeseg_ros.core.mapping.map_outlines import unite_outlines, widened
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
    for n in range(15 * len(frames)):
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
    # All that it holds: planes, their corners, their evidence.
    assert max(sizes[10:]) < 1.1 * max(sizes[5:10])


@pytest.mark.parametrize('kind', ['same wall', 'corridor'])
def test_outlines_and_their_evidence_are_bounded_however_long_one_looks(kind):
    random, outline, evidence = np.random.default_rng(0), shapely.Polygon(), Evidence()
    for n in range(400):
        at = random.uniform(-3, 3, 2) if kind == 'same wall' else np.array([0.2 * n, 0.0])
        corners = at + random.uniform(-1, 1, (12, 2))
        part = shapely.MultiPoint(corners).convex_hull
        outline, _ = unite_outlines(outline, part, 0.05)
        evidence.follow(outline)
        assert shapely.get_num_coordinates(outline) <= 400
        # Sides of cells are powers of two: up to four times as many, and those at borders.
        assert len(evidence.centres) <= 400
    assert outline.area > 10


def test_what_is_widened_can_be_united():
    # Of this outline with a narrow notch, the corners of the border that GEOS 3.14 draws cross.
    notch = [
        (1.45, 0.49),
        (1.3893393874173412, 0.054875106286694),
        (1.3901640133969233, 0.042876451067813),
        (0.96, 0.0659501798),
        (1.3911041020756671, 0.0291977649595514),
        (1.3950271222734791, -0.0278838307404879),
        (-0.84, -0.74),
    ]
    wide = widened(shapely.Polygon(notch), 0.015)
    assert wide.is_valid
    assert wide.union(shapely.box(1.3, -0.1, 1.5, 0.1)).area > wide.area


def test_an_outline_of_details_alone_is_empty():
    speck = shapely.box(0, 0, 0.01, 0.01)
    outline, _ = unite_outlines(shapely.Polygon(), speck, 0.05)
    assert outline.is_empty
