"""Contingency table of two segmentations, the pixels that regions share, and measures of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from rangeseg_ros.core.arrays import Floats


class ComparisonError(ValueError):
    """Label images, or a tolerance, that cannot be compared."""


def check_tolerance(tolerance: float) -> float:
    """Return `tolerance`, or raise ComparisonError when it is not in (0.5, 1]."""
    if not 0.5 < tolerance <= 1:
        raise ComparisonError(f'tolerance must be above 0.5 and at most 1, not {tolerance:g}')
    return tolerance


@dataclass(frozen=True, eq=False)
class Overlap:
    """Contingency table of the regions of the truth and of a segmentation.

    Attributes
    ----------
    truth, labels : (G,), (M,) integer
        Labels of the regions, ascending.
    truth_sizes, label_sizes : (G,), (M,) int64
        Pixels of the regions, over the whole image (or all judged pixels).
    shared : (G, M) int64
        Pixels that each two of them share.
    """

    truth: NDArray[np.integer]
    labels: NDArray[np.integer]
    truth_sizes: NDArray[np.int64]
    label_sizes: NDArray[np.int64]
    shared: NDArray[np.int64]

    @classmethod
    def between(
        cls, truth: ArrayLike, labels: ArrayLike, judged: ArrayLike | None = None
    ) -> Overlap:
        """Count the overlaps of two label images (H, W), 0 = no region, where they are judged.

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
        regions, g, sizes = np.unique(first, return_inverse=True, return_counts=True)
        found, m, found_sizes = np.unique(second, return_inverse=True, return_counts=True)
        place = g.ravel() * len(found) + m.ravel()
        shared = np.bincount(place, minlength=len(regions) * len(found))
        table = shared.reshape(len(regions), len(found))
        a, b = regions != 0, found != 0
        return cls(regions[a], found[b], sizes[a], found_sizes[b], table[np.ix_(a, b)])

    @cached_property
    def of_truth(self) -> Floats:
        """(G, M) share of the truth's region that is in the segmentation's."""
        return self.shared / self.truth_sizes[:, None]

    @cached_property
    def of_labels(self) -> Floats:
        """(G, M) share of the segmentation's region that is in the truth's."""
        return self.shared / self.label_sizes

    @cached_property
    def iou(self) -> Floats:
        """(G, M) intersection over union."""
        return self.shared / (self.truth_sizes[:, None] + self.label_sizes - self.shared)

    @property
    def best_iou(self) -> Floats:
        """(G,) highest intersection over union of each region of the truth; 0 when untouched."""
        best: Floats = self.iou.max(axis=1, initial=0)
        return best


def overlap_figures(overlaps: Iterable[Overlap], threshold: float = 0.8) -> dict[str, float]:
    """Figures that need no classes, pooled over the regions and pixels of all images.

    They are `mean_iou` (best intersection over union, mean over the regions of the truth),
    `pixel_accuracy` (share of the truth's pixels that the best one-to-one assignment of regions
    gets right), `precision` and `recall` at an intersection over union of `threshold`, above 0.5.
    NaN without regions.
    """
    check_tolerance(threshold)
    items = list(overlaps)
    regions = sum(len(item.truth) for item in items)
    found = sum(len(item.labels) for item in items)
    pixels = sum(int(item.truth_sizes.sum()) for item in items)
    hits = sum(int((item.iou >= threshold).sum()) for item in items)
    right = sum(
        int(item.shared[linear_sum_assignment(item.shared, maximize=True)].sum()) for item in items
    )
    return {
        'mean_iou': _ratio(sum(float(item.best_iou.sum()) for item in items), regions),
        'pixel_accuracy': _ratio(right, pixels),
        'precision': _ratio(hits, found),
        'recall': _ratio(hits, regions),
    }


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float('nan')
