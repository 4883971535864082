"""Running the segmenter over a data set, and what is kept of each image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.evaluation.datasets import Case
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.overlap import Overlap
from rangeseg_ros.evaluation.pictures import class_picture
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.io.images import write_image


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
