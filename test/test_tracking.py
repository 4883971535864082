"""Ids over time: motion, occlusion, splitting and merging, loops; figures of known tracks."""

from dataclasses import replace

import numpy as np
import pytest
from planes_of_labels import fit_planes, painted
from scipy.spatial.transform import Rotation
from tracks import ids_of_faces, track_figures

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.tracking.tracker import Tracker, Tracks, _camera_motion
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera

KINECT = SensorModel.from_config(Config())
CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
FLOOR = (0.0, -1.0, 0.0, 1.0)
WALL = (0.0, 0.0, -1.0, 3.0)
SIDE = (-1.0, 0.0, 0.0, 1.2)
BOX = (0.0, -0.6, -0.8, 1.4)


def moved(plane, rotation, shift):
    """Equation of a plane of the world seen by a camera at rotation, shift."""
    normal = np.array(plane[:3])
    return (*(normal @ rotation), plane[3] + normal @ shift)


def frame(*regions):
    """Label image and planes of (rows, columns, equation) painted one over the other."""
    parts = (((rows, columns), plane[:3], plane[3]) for rows, columns, plane in regions)
    return painted(CAMERA, *parts)


def ids(tracker, found, stamp=0):
    return [plane.id for plane in tracker.track(*found, stamp)]


ALL = slice(None)
GROUND = slice(90, 120), ALL, FLOOR
STAY = GROUND, (slice(0, 40), slice(0, 100), WALL), (slice(0, 40), slice(110, 160), SIDE)
"""Three planes that fix the motion of the camera, in the corners of the image."""
MIDDLE = slice(50, 80), slice(50, 100)


def wall(first, last):
    return slice(0, 80), slice(first, last), WALL


LEFT, RIGHT = ((slice(50, 80), slice(a, a + 24), BOX) for a in (10, 120))
SLIVER = wall(0, 10), GROUND
NEARER = (*BOX[:3], BOX[3] - 0.4)


def test_a_hidden_plane_moves_along_with_the_camera():
    # Over 20 frames the camera turns 20 degrees and comes 0.4 m nearer, so that the equation of
    # the hidden box becomes another one altogether.
    tracker = Tracker()
    assert ids(tracker, frame(*STAY, (*MIDDLE, BOX))) == [1, 2, 3, 4]
    for k in range(1, 21):
        rotation = Rotation.from_euler('xy', [k / 2, k], degrees=True).as_matrix()
        pose = rotation, np.array([0, 0, 0.02 * k])
        view = [(rows, columns, moved(plane, *pose)) for rows, columns, plane in STAY]
        if k < 20:
            assert ids(tracker, frame(*view)) == [1, 2, 3]
    box = moved(BOX, *pose)
    assert np.degrees(np.arccos(np.dot(box[:3], BOX[:3]))) > 15
    # Another plane, parallel to the box and 0.2 m behind it, is not the box.
    decoy = (*box[:3], box[3] + 0.2)
    right = slice(50, 80), slice(20, 48)
    assert ids(tracker, frame(*view, (*right, decoy), (*MIDDLE, box))) == [1, 2, 3, 5, 4]


def test_moved_planes_still_hold_their_points():
    tracks, shift = Tracks.of(*reversed(frame(*STAY))), np.array([1, 2, 3.0])
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    there = tracks.moved(rotation, shift)
    np.testing.assert_allclose(there.centroid, tracks.centroid @ rotation.T + shift)
    np.testing.assert_allclose(np.linalg.norm(there.plane[:, :3], axis=1), 1)
    off = [(t.plane[:, :3] * t.centroid).sum(axis=1) + t.plane[:, 3] for t in (tracks, there)]
    np.testing.assert_allclose(off[0], off[1], atol=1e-12)


def test_what_moves_by_itself_does_not_move_the_camera():
    """Three planes stand, a box before them comes nearer: the farther, the less it counts."""
    shifts = []
    for nearer in (0.1, 0.3, 0.6):
        box = (*MIDDLE, (*BOX[:3], BOX[3] - nearer))
        first, second = frame(*STAY, (*MIDDLE, BOX)), frame(*STAY, box)
        then, now = (Tracks.of(planes, labels) for labels, planes in (first, second))
        pairs = np.arange(4), np.arange(4)
        rotation, shift = _camera_motion(then, now, pairs, np.full(6, 1.0), None)
        shifts.append(np.linalg.norm(shift) + np.linalg.norm(rotation - np.eye(3)))
    assert shifts[2] < shifts[1] < shifts[0] < 0.25 and shifts[2] < 0.06


@pytest.mark.parametrize(
    ('frames', 'numbers'),
    [
        # Another plane in the same pixels is new.
        ([(*STAY, (*MIDDLE, BOX)), (*STAY, (*MIDDLE, NEARER))], [[1, 2, 3, 4], [1, 2, 3, 5]]),
        # Parts far apart are not renamed.
        ([(*STAY, LEFT, RIGHT), (*STAY, RIGHT)], [[1, 2, 3, 4, 5], [1, 2, 3, 5]]),
        # Two bad pairs are not worth more than a sure one: the large part could take the id of the
        # scrap that is gone, and leave its own to the scrap that is new.
        ([(wall(0, 15), wall(20, 140)), (wall(145, 160), wall(26, 140))], [[1, 2], [3, 2]]),
        # A sliver does not give its id to what swallows it.
        ([SLIVER, (*SLIVER, wall(20, 160)), (wall(0, 160), GROUND)], [[1, 2], [1, 2, 3], [3, 2]]),
    ],
)
def test_ids_of_frames_one_after_the_other(frames, numbers):
    tracker = Tracker()
    assert [ids(tracker, frame(*regions)) for regions in frames] == numbers


def test_the_largest_part_keeps_the_id_and_the_parts_theirs():
    tracker = Tracker()
    whole = frame(wall(0, 160), GROUND)
    assert ids(tracker, whole) == [1, 2]
    assert ids(tracker, frame(wall(0, 50), wall(70, 160), GROUND)) == [3, 1, 2]
    # The occluder moves on: the part with the first id becomes the smaller one, and keeps it.
    for edge in range(50, 110, 6):
        now = frame(wall(0, edge), wall(edge + 20, 160), GROUND)
        assert ids(tracker, now) == [3, 1, 2]
    # Merged, it is the part that overlaps most; split again, both parts have their ids.
    assert ids(tracker, whole) == [3, 2]
    assert ids(tracker, now) == [3, 1, 2]


def test_a_surface_keeps_its_id_through_its_parts():
    tracker = Tracker()

    def surfaces(*walls):
        return [(p.id, p.surface) for p in tracker.track(*frame(*walls, GROUND), 0)]

    left, right = wall(0, 60), wall(80, 160)
    assert surfaces(left) == [(1, 1), (2, 2)]
    assert surfaces(left, right) == [(1, 1), (3, 1), (2, 2)]
    assert surfaces(right) == [(3, 1), (2, 2)]
    assert surfaces(right) == [(3, 1), (2, 2)]
    assert surfaces(left, right) == [(1, 1), (3, 1), (2, 2)]


def test_surfaces_taken_for_one_come_apart_with_their_ids():
    tracker = Tracker()
    labels, planes = frame(*reversed(STAY))

    def surfaces(*groups):
        grouped = [replace(p, surface=g) for p, g in zip(planes, groups, strict=True)]
        return [p.surface for p in tracker.track(labels, grouped, 0)]

    for groups in ([1, 2, 3], [1, 1, 3], [1, 2, 3], [1, 2, 2], [1, 2, 3], [1, 2, 2]):
        assert surfaces(*groups) == groups
    # What loses its id to a larger plane that had it before has a new one, of which no other is.
    assert surfaces(1, 1, 3) == [1, 1, 2] and surfaces(1, 2, 3) == [1, 4, 2]
    tracker.reset()
    assert surfaces(1, 2, 3) == [5, 6, 7]


@pytest.mark.parametrize('rate', [2, 30, 120])
def test_memory_is_of_seconds_at_any_rate(rate):
    for hidden, same in ((0.9, True), (1.1, False)):
        tracker, stamp = Tracker(Config(track_time=1.0)), 10**9
        box = (*MIDDLE, BOX)
        assert ids(tracker, frame(*STAY, box), stamp) == [1, 2, 3, 4]
        for k in range(1, round(hidden * rate) + 1):
            assert ids(tracker, frame(*STAY), stamp + k * 10**9 // rate) == [1, 2, 3]
        stamp += round((hidden + 0.02) * 1e9) + 10**9 // rate
        if rate > 2:
            assert ids(tracker, frame(*STAY, box), stamp) == [1, 2, 3, 4 if same else 5]


def test_a_reset_and_another_image_size_begin_anew_without_reusing_ids():
    tracker = Tracker()
    labels, planes = frame(*STAY)
    assert ids(tracker, (labels, planes)) == [1, 2, 3]
    assert ids(tracker, (labels[::2, ::2], planes)) == [4, 5, 6]
    tracker.reset()
    assert ids(tracker, (labels[::2, ::2], planes)) == [7, 8, 9]
    assert ids(tracker, (labels[::2, ::2], [])) == []
    assert ids(tracker, (labels[::2, ::2], planes)) == [7, 8, 9]


@pytest.mark.parametrize('seed', [0, 5])
def test_simulated_rooms_keep_their_ids(seed):
    """True labels of a hand-held camera, two seconds: no face changes its id, none is mixed up."""
    camera, tracker = kinect_camera(160, 120), Tracker()
    scene, frames = kinect_room(seed, frames=60), []
    for k in range(0, 60, 2):  # every other frame, so twice the speed
        view = simulate(scene, Kinect(0, 'measured'), camera, frame=k)
        planes = fit_planes(view.labels, RangeImage.from_depth(view.depth, camera), KINECT)
        tracked = tracker.track(view.labels, planes, 10**9 + k * 10**9 // 30)
        faces = {plane.label: plane.face for plane in view.planes}
        assert len(set(faces.values())) >= 5
        found = {plane.label: plane.id for plane in tracked}
        frames.append(ids_of_faces(view.labels, found, view.labels, faces, 100))
    figures = track_figures(frames)
    assert figures['coverage'] == 1 and figures['switches'] == figures['transfers'] == 0


@pytest.mark.parametrize(
    ('frames', 'figures'),
    [
        ([{7: [1], 8: [2]}] * 4, (0, 0, 1, 4)),
        ([{7: [1]}, {7: [2]}, {7: [2]}, {7: [1]}], (2, 0, 1, 2)),
        # A face stays with its id while any part has it.
        ([{7: [1]}, {7: [2, 1]}, {7: [1, 2]}], (0, 0, 1, 3)),
        ([{7: [1]}, {7: [2, 1]}, {7: [2]}], (1, 0, 1, 1.5)),
        ([{7: [1]}, {7: []}], (0, 0, 0.5, 1)),
        ([{7: [1], 8: [2]}, {7: [2], 8: [1]}], (2, 2, 1, 1)),
        ([], (0, 0, 0, 0)),
    ],
)
def test_figures_of_tracks(frames, figures):
    assert tuple(track_figures(frames).values()) == figures


def test_ids_of_faces():
    truth = np.repeat(np.uint16([1, 2, 3, 9, 0]), [40, 30, 20, 10, 10])[None]
    labels = np.repeat(np.uint16([1, 2, 3, 0, 4]), [30, 35, 5, 20, 20])[None]
    ids = {1: 11, 2: 12, 4: 14}
    # Label 1: 30 of 30 on face 5. Label 2: 10 on region 1 and 25 on region 2, both face 5.
    # Label 3 is no plane. Label 4: 10 of 20 on region 9, of no face.
    found = ids_of_faces(labels, ids, truth, {1: 5, 2: 5, 3: 6}, min_pixels=20)
    assert found == {5: [12, 11], 6: []}
    assert ids_of_faces(labels, ids, truth, {1: 5, 2: 5, 3: 6}, min_pixels=21) == {5: [12, 11]}
