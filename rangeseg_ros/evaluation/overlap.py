"""Contingency table of two segmentations, the pixels that regions share, and measures of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment


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
