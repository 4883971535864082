"""Running the segmenter over a data set: what is kept of each image, and its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.drawing import borders
from rangeseg_ros.evaluation.datasets import Case, Sample
from rangeseg_ros.evaluation.hoover import Classification, RegionClass, classify
from rangeseg_ros.evaluation.overlap import Overlap
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.io.images import write_image

# White, green and grey are those of figures C.1 and 6.6; the others are ours.
CORRECT, OVER, UNDER = (255, 255, 255), (80, 200, 80), (90, 130, 255)
MISSED, NOISE = (255, 190, 60), (230, 70, 70)
NO_DATA, UNLABELLED = (128, 128, 128), (40, 40, 40)


@dataclass(frozen=True, eq=False)
class Measurement:
    """Everything the figures of an image are computed from.

    Angles are (label, label, degrees) of the truth, planes (nx, ny, nz, d) of each label, where
    known (of the found ones normals do), timings milliseconds per stage.
    """

    name: str
    overlap: Overlap
    angles: Sequence[tuple[int, int, float]]
    true_planes: Mapping[int, Any]
    found_planes: Mapping[int, Any]
    timings: Mapping[str, float]


@dataclass(frozen=True)
class Task:
    """An image, the parameters to segment it with, and a folder for its `pictures`, or None."""

    case: Case
    config: Config
    output: Path | None = None

    def run(self) -> Measurement:
        """Segment the image and measure it."""
        sample = self.case.load()
        result = Segmenter(self.config).segment(corrected(sample.image, self.config))
        overlap = sample.truth.compare(result.labels)
        if self.output:
            paths = self.pictures(self.output)
            picture = class_picture(sample, result.labels, overlap, classify(overlap, 0.8))
            write_image(paths['labels'], result.labels)
            write_image(paths['classes'], picture)
        return Measurement(
            self.case.name,
            overlap,
            sample.angles,
            sample.planes,
            {plane.label: (*plane.normal, plane.distance) for plane in result.planes},
            result.timings,
        )

    def pictures(self, folder: Path) -> dict[str, Path]:
        """Where pictures of the image are left."""
        return {kind: folder / f'{self.case.name}_{kind}.png' for kind in ('labels', 'classes')}


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
