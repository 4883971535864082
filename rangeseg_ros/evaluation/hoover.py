"""Comparing a segmentation with the truth: Hoover's five metrics, and measures by overlap.

References
----------
A. Hoover et al., "An experimental comparison of range image segmentation algorithms", IEEE TPAMI
18(7), 1996, and the comparison tool published with it (thesis 6.1.2).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment


class ComparisonError(ValueError):
    """Label images, or a tolerance, that cannot be compared."""


class RegionClass(IntEnum):
    """What became of a region; UNMATCHED is missed in the truth, noise in a segmentation."""

    UNMATCHED = 0
    CORRECT = 1
    OVER = 2
    UNDER = 3


def check_tolerance(tolerance: float) -> float:
    """Return `tolerance`, or raise ComparisonError when it is not in (0.5, 1]."""
    if not 0.5 < tolerance <= 1:
        raise ComparisonError(f'tolerance must be above 0.5 and at most 1, not {tolerance:g}')
    return tolerance


@dataclass(frozen=True, eq=False)
class Overlap:
    """Which regions of the truth and of a segmentation share how many pixels.

    Attributes
    ----------
    truth, labels : (G,), (M,) integer
        Labels of the regions, ascending.
    truth_sizes, label_sizes : (G,), (M,) int64
        Pixels of the regions, over the whole image (or all judged pixels).
    pairs : (K, 2) int64
        Indices (into `truth`, into `labels`) of the pairs that overlap.
    shared : (K,) int64
        Pixels each pair shares.
    """

    truth: NDArray[np.integer]
    labels: NDArray[np.integer]
    truth_sizes: NDArray[np.int64]
    label_sizes: NDArray[np.int64]
    pairs: NDArray[np.int64]
    shared: NDArray[np.int64]

    @classmethod
    def between(
        cls, truth: ArrayLike, labels: ArrayLike, judged: ArrayLike | None = None
    ) -> Overlap:
        """Count the overlaps of two label images.

        Parameters
        ----------
        truth, labels : (H, W) integer
            0 = no region.
        judged : (H, W) bool, optional
            Pixels that count; all when not given.

        Raises
        ------
        ComparisonError
            Images of different shape, or not of integers.
        """
        first, second = np.asarray(truth), np.asarray(labels)
        if first.shape != second.shape:
            raise ComparisonError(f'label images differ in size: {first.shape}, {second.shape}')
        if first.dtype.kind not in 'iu' or second.dtype.kind not in 'iu':
            raise ComparisonError(f'labels must be integers, not {first.dtype}, {second.dtype}')
        if judged is not None:
            first, second = first[np.asarray(judged)], second[np.asarray(judged)]
        truth_labels, g, truth_sizes = np.unique(first, return_inverse=True, return_counts=True)
        label_labels, m, label_sizes = np.unique(second, return_inverse=True, return_counts=True)
        width = max(len(label_labels), 1)
        cells, shared = np.unique(g.ravel() * width + m.ravel(), return_counts=True)
        pairs = np.stack([cells // width, cells % width], axis=1)
        real = (truth_labels[pairs[:, 0]] != 0) & (label_labels[pairs[:, 1]] != 0)
        is_truth, is_label = truth_labels != 0, label_labels != 0
        # Leaving out the background moves the indices down by the zeros before them.
        pairs = np.stack(
            [(np.cumsum(is_truth) - 1)[pairs[:, 0]], (np.cumsum(is_label) - 1)[pairs[:, 1]]],
            axis=1,
        )
        return cls(
            truth_labels[is_truth],
            label_labels[is_label],
            truth_sizes[is_truth].astype(np.int64),
            label_sizes[is_label].astype(np.int64),
            pairs[real].astype(np.int64),
            shared[real].astype(np.int64),
        )

    @cached_property
    def of_truth(self) -> NDArray[np.float64]:
        """(K,) share of the truth's region that each pair covers."""
        return self.shared / self.truth_sizes[self.pairs[:, 0]]

    @cached_property
    def of_labels(self) -> NDArray[np.float64]:
        """(K,) share of the segmentation's region that each pair covers."""
        return self.shared / self.label_sizes[self.pairs[:, 1]]

    @cached_property
    def iou(self) -> NDArray[np.float64]:
        """(K,) intersection over union of each pair."""
        g, m = self.pairs.T
        return self.shared / (self.truth_sizes[g] + self.label_sizes[m] - self.shared)

    @cached_property
    def best_iou(self) -> NDArray[np.float64]:
        """(G,) highest intersection over union of each region of the truth; 0 when untouched."""
        best = np.zeros(len(self.truth))
        np.maximum.at(best, self.pairs[:, 0], self.iou)
        return best

    @cached_property
    def assigned(self) -> NDArray[np.int64]:
        """(G,) pixels shared with the partner in the one-to-one assignment that shares most."""
        table = np.zeros((len(self.truth), len(self.labels)), np.int64)
        table[self.pairs[:, 0], self.pairs[:, 1]] = self.shared
        rows, columns = linear_sum_assignment(table, maximize=True)
        shared = np.zeros(len(self.truth), np.int64)
        shared[rows] = table[rows, columns]
        return shared


@dataclass(frozen=True, eq=False)
class Classification:
    """Classes of all regions at one tolerance.

    Attributes
    ----------
    truth : (G,) int8
        `RegionClass` of each region of the truth, in the order of `Overlap.truth`.
    labels : (M,) int8
        The same for the segmentation.
    matches : dict
        Label in the truth -> label in the segmentation, for the regions in class CORRECT.
    """

    truth: NDArray[np.int8]
    labels: NDArray[np.int8]
    matches: dict[int, int]

    def counts(self) -> dict[str, int]:
        """The figures of the reference tool; `under` counts regions of the segmentation."""
        return {
            'regions': len(self.truth),
            'correct': int((self.truth == RegionClass.CORRECT).sum()),
            'over': int((self.truth == RegionClass.OVER).sum()),
            'under': int((self.labels == RegionClass.UNDER).sum()),
            'missed': int((self.truth == RegionClass.UNMATCHED).sum()),
            'noise': int((self.labels == RegionClass.UNMATCHED).sum()),
        }


def classify(overlap: Overlap, tolerance: float) -> Classification:
    """Classify every region as the reference tool does (eqs. 6.1, 6.2).

    Correct pairs first; then over-segmentation, which takes a region of the truth unless its
    present class has a mean measure at least as high; then under-segmentation, the mirror image.

    Parameters
    ----------
    overlap : Overlap
        Overlaps of the two label images.
    tolerance : float
        T of the thesis, in (0.5, 1].

    Raises
    ------
    ComparisonError
        A tolerance out of range.

    Notes
    -----
    As T > 0.5, at most one region of the other image can hold a region to the share T. So no two
    regions of the same image ever claim the same partner, and the order among them is immaterial.
    """
    check_tolerance(tolerance)
    g, m = overlap.pairs.T
    truth = _Classes(overlap.truth_sizes)
    labels = _Classes(overlap.label_sizes)
    inside_truth = overlap.of_labels >= tolerance
    inside_labels = overlap.of_truth >= tolerance

    correct = inside_truth & inside_labels
    mean = (overlap.of_truth[correct] + overlap.of_labels[correct]) / 2
    truth.assign(g[correct], RegionClass.CORRECT, mean)
    labels.assign(m[correct], RegionClass.CORRECT, mean)
    matched = dict(zip(g[correct], m[correct], strict=True))

    truth.split(RegionClass.OVER, labels, g, m, overlap.shared, inside_truth, tolerance)
    labels.split(RegionClass.UNDER, truth, m, g, overlap.shared, inside_labels, tolerance)

    matches = {
        int(overlap.truth[i]): int(overlap.labels[j])
        for i, j in matched.items()
        if truth.kind[i] == RegionClass.CORRECT
    }
    return Classification(truth.kind, labels.kind, matches)


class _Classes:
    """Class, and mean of the two measures it was given for, of the regions of one image."""

    def __init__(self, sizes: NDArray[np.int64]) -> None:
        self.sizes = sizes
        self.kind = np.zeros(len(sizes), np.int8)
        self.mean = np.zeros(len(sizes))

    def assign(self, index: NDArray, kind: RegionClass, mean: NDArray) -> None:
        self.kind[index] = kind
        self.mean[index] = mean

    def split(
        self,
        kind: RegionClass,
        other: _Classes,
        whole: NDArray[np.int64],
        part: NDArray[np.int64],
        shared: NDArray[np.int64],
        inside: NDArray[np.bool_],
        tolerance: float,
    ) -> None:
        """Give `kind` to the regions here that two or more regions of `other` make up.

        `whole` and `part` are the pairs' indices here and in `other`; `inside` tells the pairs
        whose part lies within the whole to the share `tolerance`.
        """
        whole, part, shared = whole[inside], part[inside], shared[inside]
        count = len(self.sizes)
        parts = np.bincount(whole, minlength=count)
        covered = np.bincount(whole, shared, count)
        spent = np.bincount(whole, other.sizes[part], count)
        of_whole = covered / self.sizes
        of_parts = covered / np.maximum(spent, 1)
        mean = (of_whole + of_parts) / 2
        taken = (parts >= 2) & (of_whole >= tolerance) & (of_parts >= tolerance)
        taken &= (self.kind == RegionClass.UNMATCHED) | (mean > self.mean)
        self.assign(np.flatnonzero(taken), kind, mean[taken])
        taken_pairs = taken[whole]
        other.assign(part[taken_pairs], kind, mean[whole[taken_pairs]])


def overlap_figures(overlaps: Iterable[Overlap], threshold: float = 0.8) -> dict[str, float]:
    """Figures that need no classes, pooled over the regions and pixels of all images.

    Parameters
    ----------
    overlaps : iterable of Overlap
        One per image.
    threshold : float
        Intersection over union from which a region counts as found, above 0.5.

    Returns
    -------
    dict
        `mean_iou` (best intersection over union, mean over the regions of the truth),
        `pixel_accuracy` (share of the truth's pixels that the best one-to-one assignment of
        regions gets right), `precision` and `recall` at `threshold`. NaN without regions.
    """
    check_tolerance(threshold)
    items = list(overlaps)
    regions = sum(len(item.truth) for item in items)
    found = sum(len(item.labels) for item in items)
    pixels = sum(int(item.truth_sizes.sum()) for item in items)
    hits = sum(int((item.iou >= threshold).sum()) for item in items)
    return {
        'mean_iou': _ratio(sum(float(item.best_iou.sum()) for item in items), regions),
        'pixel_accuracy': _ratio(sum(int(item.assigned.sum()) for item in items), pixels),
        'precision': _ratio(hits, found),
        'recall': _ratio(hits, regions),
    }


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float('nan')


def angle_errors(
    angles: Iterable[tuple[int, int, float]],
    normals: Mapping[int, ArrayLike],
    matches: Mapping[int, int],
) -> NDArray[np.float64]:
    """Errors of the angles between regions, over the pairs whose regions are both correct.

    Parameters
    ----------
    angles : iterable of (label, label, degrees)
        Angles between regions of the truth, as in a `.gt-ang` file.
    normals : mapping of label to (3,) float
        Normals of the segmentation's regions.
    matches : mapping
        `Classification.matches`.

    Returns
    -------
    (N,) float64
        Absolute differences in degrees, the angles folded to 0..90.
    """
    errors = []
    for first, second, degrees in angles:
        if first in matches and second in matches:
            a, b = (np.asarray(normals[matches[label]], float) for label in (first, second))
            # atan2 of sine and cosine: the arc cosine alone is blunt near 0.
            found = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))
            errors.append(abs(min(degrees, 180.0 - degrees) - found))
    return np.array(errors)


def plane_errors(
    truth: Mapping[int, ArrayLike], found: Mapping[int, ArrayLike], matches: Mapping[int, int]
) -> NDArray[np.float64]:
    """Errors of the planes of correct regions.

    Parameters
    ----------
    truth, found : mapping of label to (4,) float
        Planes (nx, ny, nz, d) with n . p + d = 0, n of unit length; the sign is immaterial.
    matches : mapping
        `Classification.matches`.

    Returns
    -------
    (N, 2) float64
        Angle between the normals in degrees, and difference of the distances from the origin
        in metres, in the order of `matches`; regions whose plane is not known are left out.
    """
    errors = []
    for label, partner in matches.items():
        if label not in truth or partner not in found:
            continue
        a, b = np.asarray(truth[label], float), np.asarray(found[partner], float)
        if a[:3] @ b[:3] < 0:
            b = -b
        angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a[:3], b[:3])), a[:3] @ b[:3]))
        errors.append((angle, abs(a[3] - b[3])))
    return np.array(errors).reshape(-1, 2)
