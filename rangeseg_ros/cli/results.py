"""What `segment` and `replay` have in common: the segmenter asked for, and its pictures."""

from __future__ import annotations

from pathlib import Path

from rangeseg_ros.core.range_image import RangeImage
from rangeseg_ros.core.segmenter import Segmentation, Segmenter
from rangeseg_ros.drawing import overlay
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.params import read_config


def make_segmenter(params_file: Path | None, exact: bool) -> Segmenter:
    """Segmenter with the parameters of the file; `exact` wins over the file."""
    return Segmenter(read_config(params_file, **({'exact': True} if exact else {})))


def write_pictures(folder: Path, stem: str, image: RangeImage, result: Segmentation) -> None:
    """Write <stem>_labels.png and <stem>_overlay.png."""
    write_image(folder / f'{stem}_labels.png', result.labels)
    picture = overlay(image.inverse, result.labels, result.planes)
    write_image(folder / f'{stem}_overlay.png', picture)
