"""Pictures of a comparison, coloured as in appendix C of the thesis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.drawing import borders
from rangeseg_ros.evaluation.datasets import Sample
from rangeseg_ros.evaluation.hoover import Classification, RegionClass
from rangeseg_ros.evaluation.overlap import Overlap

# White, green and grey are those of figures C.1 and 6.6; the others are ours.
CORRECT, OVER, UNDER = (255, 255, 255), (80, 200, 80), (90, 130, 255)
MISSED, NOISE = (255, 190, 60), (230, 70, 70)
NO_DATA, UNLABELLED = (128, 128, 128), (40, 40, 40)


def class_picture(
    sample: Sample, labels: NDArray[np.uint16], overlap: Overlap, classes: Classification
) -> NDArray[np.uint8]:
    """Ground truth (left) and segmentation (right), each region in the colour of its class.

    Correct white, over-segmented green, under-segmented blue, missed orange, noise red; no
    measurement grey, no region dark. (H, 2 W + 4, 3) uint8 RGB, for labels (H, W).
    """
    gap = np.full((labels.shape[0], 4, 3), 255, np.uint8)
    left = _coloured(sample.truth.labels, overlap.truth, classes.truth, MISSED)
    right = _coloured(labels, overlap.labels, classes.labels, NOISE)
    for picture, regions in ((left, sample.truth.labels), (right, labels)):
        picture[~sample.image.valid & (regions == 0)] = NO_DATA
    return np.hstack([left, gap, right])


def _coloured(
    labels: NDArray[np.uint16],
    regions: NDArray[np.integer],
    kinds: NDArray[np.int8],
    unmatched: tuple[int, int, int],
) -> NDArray[np.uint8]:
    palette = np.full((int(labels.max(initial=0)) + 1, 3), UNLABELLED, np.uint8)
    for kind, colour in (
        (RegionClass.UNMATCHED, unmatched),
        (RegionClass.CORRECT, CORRECT),
        (RegionClass.OVER, OVER),
        (RegionClass.UNDER, UNDER),
    ):
        palette[regions[kinds == kind]] = colour
    picture = palette[labels]
    picture[borders(labels)] = 0
    return picture
