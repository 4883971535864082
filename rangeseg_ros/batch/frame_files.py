"""Files of one segmented image: one row of the table for each kind."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from numpy.typing import NDArray

from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.drawing import overlay
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.tables import STAIRS, columns, stairs_values, values, write_table


class FrameFile(NamedTuple):
    """A kind of file: what follows the stem of the image in its name, and what writes it."""

    ending: str
    write: Callable[[Path, RangeImage, Segmentation], None]


def _image(ending: str, pick: Callable[[RangeImage, Segmentation], NDArray]) -> FrameFile:
    return FrameFile(ending, lambda path, image, result: write_image(path, pick(image, result)))


def _planes(path: Path, image: RangeImage, result: Segmentation) -> None:
    write_table(path, columns(), map(values, result.planes))


def _stairs(path: Path, image: RangeImage, result: Segmentation) -> None:
    write_table(path, STAIRS, map(stairs_values, result.stairs))


FRAME_FILES = {
    'labels': _image('_labels.png', lambda image, result: result.labels),
    'curved': _image('_curved.png', lambda image, result: result.curved),
    'overlay': _image(
        '_overlay.png', lambda image, result: overlay(image.inverse, result.labels, result.planes)
    ),
    'normals': _image('_normals.tiff', lambda image, result: result.normals),
    'terrain': _image('_terrain.png', lambda image, result: result.terrain),
    'height': _image('_height.tiff', lambda image, result: result.height),
    'planes': FrameFile('_planes.csv', _planes),
    'stairs': FrameFile('_stairs.csv', _stairs),
}


def write_frame(
    folder: Path, stem: str, image: RangeImage, result: Segmentation, names: Iterable[str]
) -> dict[str, Path]:
    """Write the files of these `names` of `FRAME_FILES` for an image; where they are."""
    paths = {name: frame_path(folder, stem, name) for name in names}
    for name, path in paths.items():
        FRAME_FILES[name].write(path, image, result)
    return paths


def frame_path(folder: Path, stem: str, name: str) -> Path:
    """Where a file of an image is written."""
    return folder / f'{stem}{FRAME_FILES[name].ending}'
