"""Hoover's metrics: cases counted by hand, every tie rule, and a literal oracle."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rangeseg_ros.evaluation.hoover import RegionClass, classify
from rangeseg_ros.evaluation.label_files import as_truth
from rangeseg_ros.evaluation.overlap import ComparisonError, Overlap, overlap_figures
from rangeseg_ros.evaluation.plane_errors import angle_errors, plane_errors

RUN = st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(1, 30))


def images(*runs):
    """Two one-row images given as runs (truth label, found label, pixels)."""
    truth, labels, counts = np.transpose(runs)
    return np.repeat(truth, counts), np.repeat(labels, counts)


def overlap(*runs):
    return Overlap.between(*images(*runs))


def test_labels_are_integers():
    with pytest.raises(ComparisonError, match='integers'):
        Overlap.between(np.zeros((2, 2)), np.zeros((2, 2), int))
    with pytest.raises(ComparisonError, match='differ in size'):
        as_truth(np.full((3, 3), 65535, np.uint16), 1).compare(np.ones((2, 2), np.uint16))


def literal(truth, labels, tolerance):
    """Classes as the reference tool is described, region by region and in its order."""
    of_truth, of_labels = (
        dict.fromkeys(np.unique(image[image > 0]), (RegionClass.UNMATCHED, 0))
        for image in (truth, labels)
    )
    for n, m in itertools.product(of_truth, of_labels):
        shares = (labels == m)[truth == n].mean(), (truth == n)[labels == m].mean()
        if min(shares) >= tolerance:
            of_truth[n] = of_labels[m] = RegionClass.CORRECT, np.mean(shares)

    def split(kind, whole, of_whole, other, of_other):
        for n, (_, before) in of_whole.items():
            parts = [m for m in of_other if (whole == n)[other == m].mean() >= tolerance]
            if len(parts) < 2:
                continue
            together = np.isin(other, parts)
            shares = together[whole == n].mean(), (whole == n)[together].mean()
            if min(shares) >= tolerance and np.mean(shares) > before:
                of_whole[n] = kind, np.mean(shares)
                of_other.update(dict.fromkeys(parts, of_whole[n]))

    split(RegionClass.OVER, truth, of_truth, labels, of_labels)
    split(RegionClass.UNDER, labels, of_labels, truth, of_truth)
    return [[kind for kind, _ in classes.values()] for classes in (of_truth, of_labels)]


@given(st.lists(RUN, min_size=1, max_size=9), st.sampled_from([0.51, 0.6, 0.75, 0.8, 0.9, 1.0]))
@example([(1, 1, 45), (1, 2, 3), (0, 2, 2), (1, 0, 27)], 0.6)
@example([(1, 1, 80), (1, 2, 15), (1, 0, 5), (2, 1, 10)], 0.8)
@example([(1, 1, 45), (2, 1, 3), (2, 0, 2), (0, 1, 27)], 0.6)
@example([(1, 1, 4), (2, 1, 3), (0, 1, 3)], 0.75)
@example([(1, 1, 3), (0, 1, 1), (1, 2, 3), (0, 2, 1)], 0.75)
@example([(1, 1, 3), (1, 2, 3), (1, 0, 2)], 0.75)
def test_classes_are_those_of_the_literal_counting(runs, tolerance):
    truth, labels = images(*runs)
    result = classify(Overlap.between(truth, labels), tolerance)
    assert [result.truth.tolist(), result.labels.tolist()] == literal(truth, labels, tolerance)


def test_overlap_figures_by_hand():
    # Truth 1 (10): 8 in found 1 (10 pixels): IoU 8/12; 2 in found 2 (4 pixels): IoU 2/12.
    # Truth 2 (6): 2 in found 2: IoU 2/8; 4 in found 3 (4): IoU 4/6.
    # Truth 3 (5): untouched, IoU 0. Mean of the best: (2/3 + 2/3 + 0) / 3.
    # One to one: 1-1 (8) and 2-3 (4): 12 of 21 pixels. No IoU reaches 0.8.
    item = overlap((1, 1, 8), (0, 1, 2), (1, 2, 2), (2, 2, 2), (2, 3, 4), (3, 0, 5))
    for figures, found in (overlap_figures([item]), 0), (overlap_figures([item], 0.6), 2 / 3):
        expected = {'mean_iou': 4 / 9, 'pixel_accuracy': 12 / 21}
        assert figures == pytest.approx({**expected, 'precision': found, 'recall': found})


def test_figures_are_of_the_best_assignment_and_pooled_over_images():
    # Greedy takes 1-1 (5) and is left with 2-2 (0): 5. Best: 1-2 (4) and 2-1 (4): 8 of 13.
    item = overlap((1, 1, 5), (1, 2, 4), (2, 1, 4))
    assert overlap_figures([item])['pixel_accuracy'] == pytest.approx(8 / 13)
    perfect, lost = overlap((1, 1, 30)), overlap((1, 0, 10), (0, 1, 10))
    figures = overlap_figures([perfect, lost])
    assert figures == {'mean_iou': 0.5, 'pixel_accuracy': 0.75, 'precision': 0.5, 'recall': 0.5}
    # Without regions they are undefined.
    assert all(np.isnan(v) for v in overlap_figures([overlap((0, 0, 4))]).values())


def test_angle_errors_of_correct_pairs():
    normals = {5: (0, 0, -1), 6: (0, -1, 0), 7: (0, np.sin(0.1), np.cos(0.1))}
    matches = {10: 5, 11: 6, 12: 7, 14: 8}
    # 5-6 is 90 degrees, 5-7 0.1 rad; 13 has no match, 14 no plane. 174 degrees are 6.
    angles = [(10, 11, 88.0), (10, 12, 0.0), (11, 13, 45.0), (10, 14, 3.0), (10, 12, 174.0)]
    off = np.degrees(0.1)
    assert angle_errors(angles, normals, matches) == pytest.approx([2.0, off, 6 - off])
    assert angle_errors([], normals, matches).shape == (0,)


def test_plane_errors():
    tilt = np.radians(3)
    truth = {1: (0, 0, -1, 2.0), 2: (0, -1, 0, 1.0), 3: (1, 0, 0, 1)}
    # 8 is the same plane with the other sign.
    found = {7: (0, -np.sin(tilt), -np.cos(tilt), 2.01), 8: (0, 1, 0, -1.5)}
    errors = plane_errors(truth, found, {1: 7, 2: 8, 3: 9, 4: 7})
    assert errors == pytest.approx(np.array([[3.0, 0.01], [0.0, 0.5]]))
    assert plane_errors(truth, found, {}).shape == (0, 2)
