"""Hoover's metrics: cases counted by hand, every tie rule, and a literal oracle."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rangeseg_ros.evaluation.hoover import RegionClass, classify
from rangeseg_ros.evaluation.label_files import as_truth
from rangeseg_ros.evaluation.overlap import ComparisonError, Overlap, overlap_figures
from rangeseg_ros.evaluation.plane_errors import angle_errors, plane_errors


def overlap(*runs):
    """Overlap of two one-row images given as runs (truth label, found label, pixels)."""
    truth = np.concatenate([np.full(n, g, np.uint16) for g, _, n in runs])
    labels = np.concatenate([np.full(n, m, np.uint16) for _, m, n in runs])
    return Overlap.between(truth[None], labels[None])


def test_images_that_cannot_be_compared():
    with pytest.raises(ComparisonError, match='size'):
        Overlap.between(np.zeros((2, 2), int), np.zeros((2, 3), int))
    with pytest.raises(ComparisonError, match='integers'):
        Overlap.between(np.zeros((2, 2)), np.zeros((2, 2), int))


def literal(truth, labels, tolerance):
    """The five metrics as the reference tool is described, pixel by pixel and in its order."""
    gts = sorted({int(v) for v in truth.flat} - {0})
    mss = sorted({int(v) for v in labels.flat} - {0})

    def size(image, k):
        return sum(int(v) == k for v in image.flat)

    def both(n, m):
        return sum(
            int(a) == n and int(b) == m for a, b in zip(truth.flat, labels.flat, strict=True)
        )

    gt_class = dict.fromkeys(gts)
    ms_class = dict.fromkeys(mss)
    for n in gts:
        for m in mss:
            m1, m2 = both(n, m) / size(truth, n), both(n, m) / size(labels, m)
            if m1 >= tolerance and m2 >= tolerance:
                gt_class[n] = ms_class[m] = ('correct', m1, m2)
    for n in gts:
        parts = [m for m in mss if both(n, m) / size(labels, m) >= tolerance]
        if len(parts) < 2:
            continue
        covered = sum(both(n, m) for m in parts)
        m1, m2 = covered / size(truth, n), covered / sum(size(labels, m) for m in parts)
        if m1 >= tolerance and m2 >= tolerance:
            if gt_class[n] and (gt_class[n][1] + gt_class[n][2]) / 2 >= (m1 + m2) / 2:
                continue
            gt_class[n] = ('over', m1, m2)
            ms_class.update(dict.fromkeys(parts, ('over', m1, m2)))
    for m in mss:
        parts = [n for n in gts if both(n, m) / size(truth, n) >= tolerance]
        if len(parts) < 2:
            continue
        covered = sum(both(n, m) for n in parts)
        m1, m2 = covered / sum(size(truth, n) for n in parts), covered / size(labels, m)
        if m1 >= tolerance and m2 >= tolerance:
            if ms_class[m] and not (m1 + m2) / 2 > (ms_class[m][1] + ms_class[m][2]) / 2:
                continue
            ms_class[m] = ('under', m1, m2)
            gt_class.update(dict.fromkeys(parts, ('under', m1, m2)))
    return (
        [c[0] if c else None for c in gt_class.values()],
        [c[0] if c else None for c in ms_class.values()],
    )


NAMES = {
    RegionClass.UNMATCHED: None,
    RegionClass.CORRECT: 'correct',
    RegionClass.OVER: 'over',
    RegionClass.UNDER: 'under',
}
RUNS = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(1, 30)), min_size=1, max_size=9
)


@given(RUNS, st.sampled_from([0.51, 0.6, 0.75, 0.8, 0.9, 1.0]))
@example([(1, 1, 45), (1, 2, 3), (0, 2, 2), (1, 0, 27)], 0.6)
@example([(1, 1, 80), (1, 2, 2), (1, 0, 20), (2, 1, 10)], 0.75)
@example([(1, 1, 80), (1, 2, 15), (1, 0, 5), (2, 1, 10)], 0.8)
@example([(1, 1, 45), (2, 1, 3), (2, 0, 2), (0, 1, 27)], 0.6)
@example([(1, 1, 4), (2, 1, 3), (0, 1, 3)], 0.75)
@example([(1, 1, 4), (1, 2, 3), (1, 0, 3)], 0.75)
@example([(1, 1, 6), (1, 2, 3), (0, 2, 3)], 0.6)
@example([(1, 1, 3), (0, 1, 1), (1, 2, 3), (0, 2, 1)], 0.75)
@example([(1, 1, 3), (1, 2, 3), (1, 0, 2)], 0.75)
@example([(1, 1, 3), (2, 1, 3), (0, 1, 2)], 0.75)
@example([(1, 1, 3), (1, 0, 1), (2, 1, 3), (2, 0, 1)], 0.75)
def test_classes_are_those_of_the_literal_counting(runs, tolerance):
    truth = np.concatenate([np.full(n, g) for g, _, n in runs])
    labels = np.concatenate([np.full(n, m) for _, m, n in runs])
    result = classify(Overlap.between(truth, labels), tolerance)
    found = ([NAMES[c] for c in result.truth], [NAMES[c] for c in result.labels])
    assert found == literal(truth, labels, tolerance)


def test_overlap_figures_by_hand():
    # Truth 1 (10): 8 in found 1 (10 pixels): IoU 8/12; 2 in found 2 (4 pixels): IoU 2/12.
    # Truth 2 (6): 2 in found 2: IoU 2/8; 4 in found 3 (4): IoU 4/6.
    # Truth 3 (5): untouched, IoU 0. Mean of the best: (2/3 + 2/3 + 0) / 3.
    # One to one: 1-1 (8) and 2-3 (4): 12 of 21 pixels. No IoU reaches 0.8.
    item = overlap((1, 1, 8), (0, 1, 2), (1, 2, 2), (2, 2, 2), (2, 3, 4), (3, 0, 5))
    figures = overlap_figures([item])
    assert figures['mean_iou'] == pytest.approx(4 / 9)
    assert figures['pixel_accuracy'] == pytest.approx(12 / 21)
    assert figures['precision'] == figures['recall'] == 0
    figures = overlap_figures([item], threshold=0.6)
    assert figures['precision'] == pytest.approx(2 / 3)
    assert figures['recall'] == pytest.approx(2 / 3)


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
    normals = {5: (0, 0, -1), 6: (0, -1, 0), 7: (0, np.sin(0.1), -np.cos(0.1))}
    matches = {10: 5, 11: 6, 12: 7}
    # 5-6 is 90 degrees; 5-7 is 0.1 rad; 13 has no match.
    angles = [(10, 11, 88.0), (10, 12, 0.0), (11, 13, 45.0)]
    assert angle_errors(angles, normals, matches) == pytest.approx([2.0, np.degrees(0.1)])
    # 174 degrees and 6 degrees are one angle between planes.
    assert angle_errors([(10, 12, 174.0)], normals, matches) == pytest.approx(
        [6 - np.degrees(0.1)]
    )
    assert angle_errors([], normals, matches).shape == (0,)


def test_plane_errors():
    tilt = np.radians(3)
    truth = {1: (0, 0, -1, 2.0), 2: (0, -1, 0, 1.0), 3: (1, 0, 0, 1)}
    found = {
        7: (0, -np.sin(tilt), -np.cos(tilt), 2.01),
        8: (0, 1, 0, -1.5),  # the same plane with the other sign
    }
    errors = plane_errors(truth, found, {1: 7, 2: 8, 3: 9, 4: 7})
    assert errors == pytest.approx(np.array([[3.0, 0.01], [0.0, 0.5]]))
    assert plane_errors(truth, found, {}).shape == (0, 2)


def test_what_is_not_judged_does_not_count():
    """0 means so where a truth says elsewhere what is judged not to be planar."""
    labels = np.zeros((4, 6), np.uint16)
    labels[:, :3], labels[:, 5] = 1, 65535
    truth = as_truth(labels, 1)
    np.testing.assert_array_equal(truth.judged, labels > 0)
    np.testing.assert_array_equal(truth.labels, labels == 1)
    assert as_truth(labels[:, :5], 1).judged is None
