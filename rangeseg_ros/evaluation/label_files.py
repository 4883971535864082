"""Label images in files, and which of two folders belong together."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Mask
from rangeseg_ros.evaluation.overlap import Overlap
from rangeseg_ros.io.files import natural_order
from rangeseg_ros.io.images import read_labels
from rangeseg_ros.segcomp import read_angles, read_normals, read_segmentation
from rangeseg_ros.simulation.render import NOT_PLANAR

SEGCOMP_SUFFIXES = ('.gt-seg', '.ms-seg')


class EvaluationError(ValueError):
    """Files that cannot be evaluated: missing, unpaired, or of an unknown layout."""


class Truth(NamedTuple):
    """Ground truth of one image: regions (H, W), 0 = none, which pixels count (None for all).

    Regions count from `min_pixels` on.
    """

    labels: NDArray[np.uint16]
    judged: Mask | None
    min_pixels: int = 1

    def compare(self, labels: NDArray) -> Overlap:
        """Overlap of a segmentation with this truth.

        Where only some pixels are judged, the label 65535 is no region in the segmentation
        either, and a found region does not count if less than half of its pixels, and fewer than
        `min_pixels`, are judged: the rim of something unjudged is no evidence.
        """
        if self.judged is not None and self.judged.shape == labels.shape:
            sizes = np.bincount(labels.ravel(), minlength=NOT_PLANAR + 1)
            seen = np.bincount(labels[self.judged], minlength=NOT_PLANAR + 1)
            ignored = (2 * seen < sizes) & (seen < self.min_pixels)
            ignored[NOT_PLANAR] = True
            labels = np.where(ignored[labels], 0, labels)
        return Overlap.between(self.labels, labels, self.judged)


def read_label_image(path: Path) -> NDArray[np.uint16]:
    """Read labels, 0 = none: a segcomp raster (regions from 10), or a PNG of 8 or 16 bits."""
    if path.suffix in SEGCOMP_SUFFIXES:
        return read_segmentation(path)
    return read_labels(path)


def read_angles_beside(path: Path) -> list[tuple[int, int, float]]:
    """Angles of the `.gt-ang` file beside a `.gt-seg`, if there is one."""
    path = path.with_suffix('.gt-ang')
    return read_angles(path) if path.exists() else []


def read_normals_beside(path: Path) -> dict[int, Floats]:
    """Normals of the `.ms-nor` file beside a `.ms-seg`, if there is one."""
    path = path.with_suffix('.ms-nor')
    return read_normals(path) if path.exists() else {}


def as_truth(labels: NDArray[np.uint16], min_pixels: int = 1) -> Truth:
    """Ground truth from a label image (H, W).

    Where the image has the label 65535, judged not to be planar, its 0 means not judged, and
    regions are compared over the judged pixels only: a found region that covers something curved
    pays for it, one that extends into unjudged pixels does not. Otherwise all pixels count, as in
    the reference tool. Regions below `min_pixels` are none; their pixels stay judged.
    """
    curved = labels == NOT_PLANAR
    judged = labels > 0 if curved.any() else None
    keep = np.bincount(labels.ravel(), minlength=1) >= min_pixels
    regions = np.where(keep[labels] & ~curved, labels, 0).astype(np.uint16)
    return Truth(regions, judged, min_pixels)


def pair_files(truth: Path, labels: Path) -> dict[str, tuple[Path, Path]]:
    """Pair the label images of two folders (or two files) by name.

    In a folder the images are its `.gt-seg` or `.ms-seg` files; else its `*_truth.png` or
    `*_labels.png`; else all its PNGs. Names are equal when they agree without suffix and without
    `_truth`, `_labels`, `_depth` at the end. EvaluationError tells of a folder without label
    images, or one without its counterpart.
    """
    if truth.is_file() and labels.is_file():
        return {_key(truth): (truth, labels)}
    if not (truth.is_dir() and labels.is_dir()):
        raise EvaluationError(f'{truth} and {labels} must be two files or two folders')
    truths, found = _label_files(truth), _label_files(labels)
    for name, path in found.items():
        if name not in truths:
            raise EvaluationError(f'{path}: no ground truth of that name in {truth}')
    for name, path in truths.items():
        if name not in found:
            raise EvaluationError(f'{path}: no segmentation of that name in {labels}')
    return {name: (path, found[name]) for name, path in truths.items()}


def _label_files(folder: Path) -> dict[str, Path]:
    for patterns in (('*.gt-seg', '*.ms-seg'), ('*_truth.png', '*_labels.png'), ('*.png',)):
        paths = [path for pattern in patterns for path in folder.glob(pattern)]
        files = {_key(path): path for path in sorted(paths, key=natural_order)}
        if len(files) < len(paths):
            raise EvaluationError(f'{folder}: several label images of the same name')
        if files:
            return files
    raise EvaluationError(f'{folder}: no label images (.gt-seg, .ms-seg, .png)')


def _key(path: Path) -> str:
    return re.sub(r'(_(truth|labels|depth))+$', '', path.stem)
