"""Figures of tracks: sequences of ids written by hand."""

import numpy as np

from rangeseg_ros.evaluation.tracks import ids_of_faces, track_figures


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
