"""Sightings of planes in recordings, computed by many processes in parts that are kept."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.calibration.calibrate import CalibrationError
from rangeseg_ros.core.calibration.sightings import Sightings, concatenate, find_sightings
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.distortion import DistortionMap
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.digest import result_key
from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.corrections import corrected, correction_files
from rangeseg_ros.io.depth_files import files_of
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.images import read_depth

PART = 10
"""Frames that one process takes at a time: what an interruption costs it."""
# Files that folders of bags hold, of which one that was cut off lacks the first.
_OF_BAGS = ('metadata.yaml', '*.mcap', '*.db3')


@dataclass(frozen=True)
class Source:
    """Frames of a recording: a bag of images or clouds, or a folder of images of one camera.

    Of a folder, the camera and metres per unit are given, of a bag its topics, see `DepthBag`.
    """

    path: Path
    camera: Camera | None = None
    depth_scale: float | None = None
    depth_topic: str | None = None
    camera_topic: str | None = None

    @property
    def is_folder(self) -> bool:
        """Whether it is a folder of images."""
        return self.path.is_dir() and not any(any(self.path.glob(name)) for name in _OF_BAGS)

    def files(self) -> list[Path]:
        """Images of a folder in the order of their names."""
        return files_of(self.path)

    def __len__(self) -> int:
        if self.is_folder:
            return len(self.files())
        with self._bag() as bag:
            return len(bag)

    def images(self, first: int, after: int) -> Iterator[RangeImage]:
        """Range images from number `first` to before `after`; ValueError where one is none."""
        if self.is_folder:
            assert self.camera is not None
            for path in self.files()[first:after]:
                try:
                    yield RangeImage.from_depth(read_depth(path), self.camera, self.depth_scale)
                except RangeImageError as error:
                    raise RangeImageError(f'{path}: {error}') from None
            return
        with self._bag() as bag:
            for frame in islice(bag, first, after):
                yield frame.range_image()

    def _bag(self) -> DepthBag:
        return DepthBag(self.path, self.depth_topic, self.camera_topic)


class Seen(NamedTuple):
    """Sightings of the frames of one part, and what they are of."""

    sightings: Sightings
    shape: tuple[int, int]
    camera: Camera | None


@dataclass(frozen=True)
class SightingsOfPart:
    """Planes in frames `first` to before `after`; what was found is kept in the folder `kept`."""

    source: Source
    config: Config
    first: int
    after: int
    kept: Path

    def run(self) -> Seen | None:
        """Segment the frames, or read what is kept; None where none can be read."""
        where = self.source.path
        settings = where.absolute(), self.source, asdict(self.config), self.first, self.after
        recorded = where.iterdir() if where.is_dir() else [where]
        path = self.kept / f'{result_key(settings, correction_files(self.config), recorded)}.npz'
        if path.exists():
            return _read(path)
        segmenter = Segmenter(self.config)
        frames, shape, camera = [], None, None
        for image in self.source.images(self.first, self.after):
            if shape not in (None, image.shape):
                raise CalibrationError(f'{self.source.path}: images of several sizes')
            shape, camera = image.shape, image.camera
            image = corrected(image, self.config)
            frames.append(find_sightings(segmenter.segment(image).labels, image))
        if shape is None:
            return None
        sightings = concatenate(frames)
        written = json.dumps(camera and asdict(camera))
        with replacing(path) as partial:
            np.savez(partial, shape=shape, camera=written, **sightings._asdict())
        return Seen(sightings, shape, camera)


def _read(path: Path) -> Seen:
    with np.load(path) as stored:
        sightings = Sightings(*(stored[name] for name in Sightings._fields))
        camera = json.loads(str(stored['camera']))
        height, width = stored['shape'].tolist()
    return Seen(sightings, (height, width), camera and Camera(**camera))


class Residuals(NamedTuple):
    """What planes leave of one frame, before and after the correction.

    Residuals (2, H, W), 1/m, NaN where there is no plane; and the numbers of planes.
    """

    images: Singles
    planes: tuple[int, int]


@dataclass(frozen=True)
class ResidualsOfFrame:
    """Residuals of one frame of a recording, the correction being that of `distortion`."""

    source: Source
    config: Config
    frame: int
    distortion: DistortionMap

    def run(self) -> Residuals | None:
        """Segment the frame without and with the correction; None where it cannot be read."""
        if (image := next(self.source.images(self.frame, self.frame + 1), None)) is None:
            return None
        image = corrected(image, self.config)
        segmenter, pictures, counts = Segmenter(self.config), [], []
        for version in (image, self.distortion.corrected(image)):
            result = segmenter.segment(version)
            residual = np.full(image.shape, np.nan, np.float32)
            along = np.where(version.valid, version.depth_over_range, 1)
            for plane in result.planes:
                mask = result.labels == plane.label
                theta = -plane.normal / (plane.distance + plane.normal @ version.place)
                error = version.inverse[mask] - version.rays[mask] @ theta
                residual[mask] = error / along[mask]
            pictures.append(residual)
            counts.append(len(result.planes))
        return Residuals(np.stack(pictures), (counts[0], counts[1]))


def parts(sources: list[Source], config: Config, kept: Path) -> list[SightingsOfPart]:
    """Tasks for all frames of the recordings, in their order."""
    return [
        SightingsOfPart(source, config, first, min(first + PART, count), kept)
        for source in sources
        for count in [len(source)]
        for first in range(0, count, PART)
    ]
