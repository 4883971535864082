"""Files of one segmented image: one row of the table for each kind."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.drawing import overlay
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.meaning import STAIRS, stairs_row, write_table
from rangeseg_ros.io.planes import PlaneTable


@dataclass(frozen=True)
class FrameFile:
    """A kind of file.

    Attributes
    ----------
    ending : str
        What follows the stem of the image in its name.
    write : callable
        (path, image, result) -> None.
    """

    ending: str
    write: Callable[[Path, RangeImage, Segmentation], None]


def _labels(path: Path, image: RangeImage, result: Segmentation) -> None:
    write_image(path, result.labels)


def _overlay(path: Path, image: RangeImage, result: Segmentation) -> None:
    write_image(path, overlay(image.inverse, result.labels, result.planes))


def _normals(path: Path, image: RangeImage, result: Segmentation) -> None:
    write_image(path, result.normals)


def _terrain(path: Path, image: RangeImage, result: Segmentation) -> None:
    write_image(path, result.terrain)


def _height(path: Path, image: RangeImage, result: Segmentation) -> None:
    write_image(path, result.height)


def _planes(path: Path, image: RangeImage, result: Segmentation) -> None:
    with replacing(path) as partial, PlaneTable(partial) as table:
        table.write(result.planes)


def _stairs(path: Path, image: RangeImage, result: Segmentation) -> None:
    write_table(path, STAIRS, [stairs_row(stairs) for stairs in result.stairs])


FRAME_FILES = {
    'labels': FrameFile('_labels.png', _labels),
    'overlay': FrameFile('_overlay.png', _overlay),
    'normals': FrameFile('_normals.tiff', _normals),
    'terrain': FrameFile('_terrain.png', _terrain),
    'height': FrameFile('_height.tiff', _height),
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
