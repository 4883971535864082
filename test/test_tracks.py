"""`rangeseg tracks`, and the figures it prints: sequences of ids written by hand."""

import json

import numpy as np
from click.testing import CliRunner

from rangeseg_ros.cli.tracks import command
from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation.tracks import ids_of_faces, track_figures, track_rooms


def test_figures_of_perfect_tracks():
    figures = track_figures([{7: [1], 8: [2]}] * 4)
    assert figures == {
        'frames': 4,
        'faces': 2,
        'switches': 0,
        'switches_per_100_frames': 0,
        'transfers': 0,
        'fragmentations': 0,
        'ids_per_face': 1,
        'coverage': 1,
        'track_length': 4,
    }


def test_figures_of_a_switch():
    figures = track_figures([{7: [1]}, {7: [2]}, {7: [2]}, {7: [1]}])
    assert (figures['switches'], figures['switches_per_100_frames']) == (2, 50)
    assert (figures['ids_per_face'], figures['track_length']) == (2, 2)
    assert figures['transfers'] == figures['fragmentations'] == 0


def test_a_face_stays_with_its_id_while_any_part_has_it():
    assert track_figures([{7: [1]}, {7: [2, 1]}, {7: [1, 2]}])['switches'] == 0
    assert track_figures([{7: [1]}, {7: [2, 1]}, {7: [2]}])['switches'] == 1


def test_fragmentation_is_a_gap_while_in_sight():
    assert track_figures([{7: [1]}, {7: []}, {7: []}, {7: [1]}])['fragmentations'] == 1
    assert track_figures([{7: [1]}, {}, {7: [1]}])['fragmentations'] == 0
    assert track_figures([{7: []}, {7: [1]}])['fragmentations'] == 0
    assert track_figures([{7: [1]}, {7: []}])['coverage'] == 0.5


def test_figures_of_a_transfer():
    figures = track_figures([{7: [1], 8: [2]}, {7: [2], 8: [1]}])
    assert (figures['transfers'], figures['switches']) == (2, 2)


def test_figures_of_nothing():
    assert track_figures([])['coverage'] == 0
    assert track_figures([{7: []}])['ids_per_face'] == 0


def test_ids_of_faces():
    truth = np.repeat(np.uint16([1, 2, 3, 9, 0]), [40, 30, 20, 10, 10])[None]
    labels = np.repeat(np.uint16([1, 2, 3, 0, 4]), [30, 35, 5, 20, 20])[None]
    ids = {1: 11, 2: 12, 4: 14}
    # Label 1: 30 of 30 on face 5. Label 2: 10 on region 1 and 25 on region 2, both face 5.
    # Label 3 is no plane. Label 4: 10 of 20 on region 9, of no face.
    found = ids_of_faces(labels, ids, truth, {1: 5, 2: 5, 3: 6}, min_pixels=20)
    assert found == {5: [12, 11], 6: []}
    assert ids_of_faces(labels, ids, truth, {1: 5, 2: 5, 3: 6}, min_pixels=21) == {5: [12, 11]}


def test_rooms_are_tracked_one_by_one():
    frames = list(track_rooms([3, 4], 2, 5, Config()))
    assert [{room for room, _ in frame.surfaces} for frame in frames] == [{3}, {3}, {4}, {4}]
    first, _, other, _ = ({i for ids in frame.planes.values() for i in ids} for frame in frames)
    assert first and other and not first & other
    for frame in frames:
        assert frame.planes.keys() == frame.surfaces.keys()


def test_command(tmp_path):
    output = tmp_path / 'figures.json'
    words = ['--rooms', '1', '--frames', '2', '--seed', '3', '--json', str(output)]
    result = CliRunner().invoke(command, words)
    assert result.exit_code == 0, result.output
    figures = json.loads(output.read_text())
    frames = list(track_rooms([3], 2, 1, Config()))
    assert figures['planes'] == track_figures([frame.planes for frame in frames])
    assert figures['surfaces'] == track_figures([frame.surfaces for frame in frames])
    assert figures['planes']['coverage'] > 0.7
    assert result.output.startswith('1 rooms, 2 frames, ')
