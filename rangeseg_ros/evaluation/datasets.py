"""Range images with ground truth in files: which layouts are known, and how they are read."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, count
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.evaluation.label_files import (
    EvaluationError,
    Truth,
    as_truth,
    read_angles_beside,
    read_label_image,
)
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.files import natural_order
from rangeseg_ros.io.images import read_depth
from rangeseg_ros.io.pcd import read_pcd
from rangeseg_ros.segcomp import (
    FIRST_REGION,
    SegcompError,
    abw_calibration,
    abw_range_image,
    perceptron_range_image,
    read_perceptron,
    read_raster,
)


class Sample(NamedTuple):
    """A range image, its true regions, and their angles and planes (nx, ny, nz, d) where known."""

    image: RangeImage
    truth: Truth
    angles: list[tuple[int, int, float]]
    planes: dict[int, Floats]


@dataclass(frozen=True)
class Case:
    """One image of a data set, not yet read: its name, unique there, and its two files.

    `sensor` ('abw' or 'perc') and `split` ('train' or 'test') are those of sets that tell them.
    """

    name: str
    image: Path
    truth: Path
    read: Callable[[Path, Path], Sample]
    sensor: str = ''
    split: str = ''

    def load(self) -> Sample:
        """Read the files; ValueError names one that is missing, malformed or of another size."""
        sample = self.read(self.image, self.truth)
        sizes = ['x'.join(map(str, a.shape[::-1])) for a in (sample.truth.labels, sample.image)]
        if sizes[0] != sizes[1]:
            raise EvaluationError(f'{self.truth}: truth is {sizes[0]}, its image {sizes[1]}')
        return sample


def read_segcomp(image: Path, truth: Path, sensor: str, split: str, number: int) -> Sample:
    """Image of the ABW or Perceptron set; the ABW calibration depends on split and number."""
    if sensor == 'abw':
        values = read_raster(image)
        with _naming(image):
            seen = abw_range_image(values, abw_calibration(number, split))
    else:
        seen = perceptron_range_image(read_perceptron(image))
    return Sample(seen, Truth(read_label_image(truth), None), read_angles_beside(truth), {})


def read_depth_case(
    image: Path,
    truth: Path,
    camera: Path,
    min_pixels: int,
    planes: Mapping[int, tuple[float, ...]] = MappingProxyType({}),
) -> Sample:
    """Depth image with intrinsics, a ROS camera calibration or a text file of fx fy cx cy.

    Regions of the truth below `min_pixels` do not count; `planes` are those that are known.
    """
    depth = read_depth(image)
    with _naming(image):
        seen = RangeImage.from_depth(depth, _camera(camera, depth.shape))
    labels = as_truth(read_label_image(truth), min_pixels)
    return Sample(seen, labels, [], {label: np.array(plane) for label, plane in planes.items()})


def read_scan(image: Path, truth: Path) -> Sample:
    """Organised laser scan of the SynPEB kind: x forward, z up, `intensity` >= 10 the plane."""
    # Such scans count their columns from right to left.
    x, y, z, label = np.moveaxis(read_pcd(image, *'xyz', 'intensity')[:, ::-1], 2, 0)
    seen = RangeImage.from_points(np.stack([-y, -z, x], axis=2).astype(np.float64))
    labels = np.where(np.isfinite(label) & (label >= FIRST_REGION), label, 0).astype(np.uint16)
    return Sample(seen, Truth(labels, None), [], {})


_SEGCOMP = re.compile(r'(abw|perc)\.(train|test)\.(\d+)')


def find_cases(folder: Path, min_pixels: int | None = None) -> list[Case]:
    """The images with ground truth in a folder, in natural order.

    Known layouts: segcomp (`abw.test.N.range`, `perc.test.N` and train, with `.gt-seg`, perhaps
    `.gt-ang`); `depth/*.png` with `truth/*.png` and `camera.yaml` (perhaps `planes.csv`), as
    `rangeseg simulate kinect` writes it; folders of `depth.png` or `depth.tiff`, `truth.png` and
    `camera.txt` or `camera.yaml`; labelled scans `*.pcd`. EvaluationError tells of a folder of
    another layout, or an image without ground truth.

    Regions of the truth of depth images that are smaller than `min_pixels` do not count; 1000 when
    not given, as both simulated and hand-drawn truth have slivers.
    """
    least = 1000 if min_pixels is None else min_pixels
    for layout in (
        _segcomp_cases(folder),
        _depth_cases(folder, least),
        _nested_cases(folder, least),
        (Case(path.stem, path, path, read_scan) for path in _sorted(folder, '*.pcd')),
    ):
        cases = list(layout)
        for case in cases:
            if not case.truth.is_file():
                raise EvaluationError(f'{case.image}: no ground truth {case.truth.name}')
        if cases:
            return _distinct(cases)
    raise EvaluationError(
        f'{folder}: no range images of a known layout (segcomp, depth/ with truth/, '
        'folders of depth.png and truth.png, *.pcd)'
    )


def _distinct(cases: list[Case]) -> list[Case]:
    """The cases under names of their own: a/b and a_b have the same one at first."""
    distinct: dict[str, Case] = {}
    for case in cases:
        names = chain([case.name], (f'{case.name}_{number}' for number in count(2)))
        name = next(name for name in names if name not in distinct)
        distinct[name] = replace(case, name=name)
    return list(distinct.values())


def _segcomp_cases(folder: Path) -> Iterator[Case]:
    for path in _sorted(folder, '*'):
        match = _SEGCOMP.match(path.name)
        if not match or path.name not in (match[0], f'{match[0]}.range'):
            continue
        truth = folder / f'{match[0]}.gt-seg'
        sensor, split, number = match.groups()
        read = partial(read_segcomp, sensor=sensor, split=split, number=int(number))
        yield Case(match[0], path, truth, read, sensor, split)


def _depth_cases(folder: Path, min_pixels: int) -> Iterator[Case]:
    planes = _true_planes(folder / 'planes.csv')
    for path in _sorted(folder, 'depth/*.png'):
        truth = folder / 'truth' / path.name
        known = planes.get(path.stem, {})
        read = partial(
            read_depth_case, camera=folder / 'camera.yaml', min_pixels=min_pixels, planes=known
        )
        yield Case(path.stem, path, truth, read)


def _nested_cases(folder: Path, min_pixels: int) -> Iterator[Case]:
    for path in sorted([*folder.glob('**/depth.png'), *folder.glob('**/depth.tiff')]):
        truth = path.with_name('truth.png')
        camera = path.with_name('camera.txt')
        if not camera.exists():
            camera = path.with_name('camera.yaml')
        name = path.parent.relative_to(folder).as_posix().replace('/', '_')
        read = partial(read_depth_case, camera=camera, min_pixels=min_pixels)
        yield Case(folder.name if name == '.' else name, path, truth, read)


def _sorted(folder: Path, pattern: str) -> list[Path]:
    return sorted(folder.glob(pattern), key=natural_order)


def _true_planes(path: Path) -> dict[str, dict[int, tuple[float, ...]]]:
    """Planes of the regions of each image, from the CSV of simulated images."""
    planes: dict[str, dict[int, tuple[float, ...]]] = {}
    if not path.exists():
        return planes
    with path.open(newline='') as file:
        try:
            for row in csv.DictReader(file):
                names = ('normal_x', 'normal_y', 'normal_z', 'distance')
                plane = tuple(float(row[name]) for name in names)
                planes.setdefault(row['image'], {})[int(row['label'])] = plane
        except (KeyError, TypeError, ValueError, csv.Error):
            raise EvaluationError(f'{path}: malformed table of planes') from None
    return planes


def _camera(path: Path, shape: tuple[int, ...]) -> Camera:
    if path.suffix != '.txt':
        return read_camera(path)
    try:
        fx, fy, cx, cy = (float(word) for word in path.read_text().split())
    except OSError as error:
        raise CameraError(f'{path}: {error.strerror}') from None
    except ValueError:
        raise CameraError(f'{path}: must hold fx fy cx cy') from None
    with _naming(path):
        return Camera(shape[1], shape[0], fx, fy, cx, cy)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Put the file's name into what is raised."""
    try:
        yield
    except (RangeImageError, CameraError, SegcompError) as error:
        raise type(error)(f'{path}: {error}') from None
