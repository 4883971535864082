"""Comparing a segmentation with the truth: Hoover's five metrics.

References
----------
A. Hoover et al., "An experimental comparison of range image segmentation algorithms", IEEE TPAMI
18(7), 1996, and the comparison tool published with it (thesis 6.1.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.evaluation.overlap import Overlap, check_tolerance


class RegionClass(IntEnum):
    """Class of a region; UNMATCHED means missed in the truth and noise in a segmentation."""

    UNMATCHED = 0
    CORRECT = 1
    OVER = 2
    UNDER = 3


@dataclass(frozen=True, eq=False)
class Classification:
    """`RegionClass` of all regions of the truth (G,) and the segmentation (M,) at one tolerance.

    In the order of `Overlap`. `matches` takes labels of correct regions of the truth to those of
    the segmentation.
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
    """Classify every region as the reference tool does (eqs. 6.1, 6.2), at T in (0.5, 1].

    Correct pairs first; then over-segmentation, which takes a region of the truth unless its
    present class has a mean measure at least as high; then under-segmentation, the mirror image.

    Notes
    -----
    As T > 0.5, at most one region of the other image can hold a region to the share T. So no two
    regions of the same image ever claim the same partner, and the order among them is immaterial.
    """
    check_tolerance(tolerance)
    truth, labels = _Classes(overlap.truth_sizes), _Classes(overlap.label_sizes)
    inside_truth = overlap.of_labels >= tolerance
    inside_labels = overlap.of_truth >= tolerance

    g, m = np.nonzero(inside_truth & inside_labels)
    mean = (overlap.of_truth[g, m] + overlap.of_labels[g, m]) / 2
    truth.assign(g, RegionClass.CORRECT, mean)
    labels.assign(m, RegionClass.CORRECT, mean)

    truth.split(RegionClass.OVER, labels, overlap.shared * inside_truth, tolerance)
    labels.split(RegionClass.UNDER, truth, (overlap.shared * inside_labels).T, tolerance)

    still = truth.kind[g] == RegionClass.CORRECT
    pairs = zip(overlap.truth[g[still]].tolist(), overlap.labels[m[still]].tolist(), strict=True)
    return Classification(truth.kind, labels.kind, dict(pairs))


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
        self, kind: RegionClass, other: _Classes, shared: NDArray[np.int64], tolerance: float
    ) -> None:
        """Assign `kind` to the regions that consist of two or more regions of `other`.

        `shared` are the pixels that a region here has of one of `other` that lies within it.
        """
        covered = shared.sum(axis=1)
        of_whole = covered / self.sizes
        of_parts = covered / np.maximum((shared > 0) @ other.sizes, 1)
        mean = (of_whole + of_parts) / 2
        taken = ((shared > 0).sum(axis=1) >= 2) & (of_whole >= tolerance) & (of_parts >= tolerance)
        taken &= (self.kind == RegionClass.UNMATCHED) | (mean > self.mean)
        self.assign(taken, kind, mean[taken])
        whole, part = np.nonzero((shared > 0) & taken[:, None])
        other.assign(part, kind, mean[whole])
