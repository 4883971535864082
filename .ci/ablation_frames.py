"""Frames to measure mechanisms on, simulated and real, and the figures of each.

Each folder in a folder of real data is a set: what `rangeseg evaluate` takes, folders of cloud.npz
(xyz) and truth.png (labels, 16 bits, 65535 = judged not planar), or N_depth.png with N_truth.png,
both of 8 bits (10 m / 255, focal length 518.9 at 640 columns; labels, 255 = unjudged). The sensor
is the name of the frame without its number.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from click.testing import CliRunner
from numpy.typing import NDArray
from tracks import ids_of_faces, track_figures

from rangeseg_ros.cli.main import rangeseg
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.tracking.tracker import Tracker
from rangeseg_ros.evaluation.datasets import find_cases
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.label_files import EvaluationError, Truth, as_truth, read_label_image
from rangeseg_ros.evaluation.overlap import Overlap
from rangeseg_ros.evaluation.plane_errors import plane_errors
from rangeseg_ros.evaluation.terrain import TerrainTask, shares
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room, walk
from rangeseg_ros.simulation.sensors.kinect import Kinect

ROOT = Path(__file__).parents[1]
# Commands of `rangeseg simulate`.
ROOMS = {
    'kinect': 'kinect',
    'kinect, independent': 'kinect --noise independent',
    'kinect, exact': 'kinect --noise none',
    'realsense': 'rooms --sensor realsense',
    'tof': 'rooms --sensor tof',
    'lidar': 'rooms --sensor lidar',
    'kinect, curved': 'kinect --scene curved',
    'realsense, curved': 'rooms --sensor realsense --scene curved',
}
DAMAGED = 'kinect', 'realsense', 'tof'
NO_DEPTH = 'rounded', 'disparity'
DAMAGES = 'holes', 'enlarged', *NO_DEPTH
# By the names of a set and a frame, the first that fits; all others are of other sensors.
KINDS = {'Kinect': r'^(annotated|nyu)|kinect', 'RealSense': r'realsense|/rs_|any6d|d4\d\d'}

Figures = dict[str, float]


class Frame(NamedTuple):
    """A range image with its truth: `kind` is the column that it counts for."""

    kind: str
    sensor: str
    image: RangeImage
    truth: Truth
    planes: Mapping[int, NDArray[np.float64]]
    least: int

    def run(self, parameters: Mapping[str, Any]) -> Figures:
        """Segment and measure."""
        begin = time.process_time()
        result = Segmenter(Config(**parameters)).segment(self.image)
        spent = time.process_time() - begin
        regions, judged, _ = self.truth
        large = np.where(np.bincount(regions.ravel())[regions] >= self.least, regions, 0)
        overlap = Truth(large, judged, self.least).compare(result.labels)
        if not len(overlap.truth):
            return {'ms': 1e3 * spent}
        iou = float(overlap.best_iou.mean())
        found = {'ms': 1e3 * spent, self.kind: iou}
        if self.kind not in NO_DEPTH:
            found['all'] = iou
        if judged is not None and (judged & (regions == 0)).any():
            sizes = np.bincount(result.labels.ravel())
            called = (sizes[result.labels] >= 3000) & (result.labels > 0)
            found['curved'] = float(called[judged & (regions == 0)].mean())
        return found | (self._exact(result, overlap) if self.planes else {})

    def _exact(self, result: Segmentation, overlap: Overlap) -> Figures:
        """What only an exact truth tells: borders, faces that are seen in parts, angles."""
        found = {p.label: [*map(float, p.normal), p.distance] for p in result.planes}
        exact = {label: [*map(float, plane)] for label, plane in self.planes.items()}
        errors = plane_errors(exact, found, classify(overlap, 0.8).matches)
        face, part = np.zeros(65536, int), np.zeros(65536, int)
        equations = np.round(list(exact.values()), 4)
        face[list(exact)] = 1 + np.unique(equations, axis=0, return_inverse=True)[1].ravel()
        part[list(found)] = [plane.surface for plane in result.planes]
        faces = Overlap.between(face[self.truth.labels], part[result.labels])
        return {
            'border': border_f(self.truth.labels, result.labels, self.image.valid),
            'faces': float(faces.best_iou[faces.truth_sizes >= self.least].mean()),
            'angle': float(np.median(errors[:, 0])) if len(errors) else float('nan'),
        }

    def damaged(self, damage: str) -> Frame:
        """With holes, enlarged, rounded to 10 cm, or as disparities; see `docs/ledger.md`."""
        inverse, labels, camera = self.image.inverse, self.truth.labels, self.image.camera
        if damage in NO_DEPTH:
            depth = self.image.points[..., 2]
            with np.errstate(divide='ignore'):
                values = np.round(depth, 1) if damage == 'rounded' else 40 / depth
            image = RangeImage.from_depth(np.nan_to_num(values, posinf=0), camera)
            return self._replace(kind=damage, image=image, planes={})
        if damage == 'holes':
            kept = np.random.default_rng(len(labels)).random(labels.shape) >= 0.3
            inverse, labels = inverse * kept, labels * kept
        else:
            shown = np.ix_(*(np.arange(n) // 4 * 4 for n in labels.shape))
            inverse, labels = inverse[shown], labels[shown]
        inverse.flags.writeable = False
        image = replace(self.image, inverse=inverse)
        return self._replace(kind=damage, image=image, truth=Truth(labels, None), planes={})


def border_f(truth: NDArray, labels: NDArray, valid: NDArray[np.bool_], reach: int = 2) -> float:
    """F measure of the borders between measured pixels, at most so many pixels apart."""
    borders = np.zeros((2, *truth.shape), np.uint8)
    for border, image in zip(borders, (truth, labels), strict=True):
        border[:, 1:] |= (image[:, 1:] != image[:, :-1]) & valid[:, 1:] & valid[:, :-1]
        border[1:] |= (image[1:] != image[:-1]) & valid[1:] & valid[:-1]
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    near = [cv2.dilate(border, window) > 0 for border in borders]
    hits = [there[border > 0] for there, border in zip(near[::-1], borders, strict=True)]
    recall, precision = (float(hit.mean()) if len(hit) else 1.0 for hit in hits)
    return 2 * precision * recall / max(precision + recall, 1e-9)


def real_frames(folder: Path, most: int) -> Iterator[Frame]:
    """Frames of all sets in a folder, so many of a sensor; what has no truth is left out."""
    count: Counter[str] = Counter()
    for part in sorted(path for path in folder.iterdir() if path.is_dir()):
        for name, load in _loaders(part):
            place = f'{part.name}/{name}'
            kind = next((k for k, v in KINDS.items() if re.search(v, place)), 'other')
            sensor = re.sub(r'[\d_.]+$', '', name) or part.name
            count[sensor] += 1
            if count[sensor] > most:
                continue
            with contextlib.suppress(ValueError):
                image, truth, least = load()
                yield Frame(kind, sensor, image, truth, {}, least)


def _loaders(folder: Path) -> Iterator[tuple[str, Callable[[], tuple[RangeImage, Truth, int]]]]:
    """Names of the frames of a set, and what reads them, their truth and the least region."""
    for path in sorted(folder.glob('*_truth.png')):
        yield path.stem.removesuffix('_truth'), lambda path=path: _of_8_bits(path)
    for path in sorted(folder.glob('*/cloud.npz')):
        yield (
            path.parent.name,
            lambda path=path: (
                RangeImage.from_points(np.load(path)['xyz'].astype(np.float32)),
                as_truth(read_label_image(path.with_name('truth.png'))),
                1000,
            ),
        )
    with contextlib.suppress(EvaluationError):
        for case in find_cases(folder, 1):
            if case.truth.suffix == '.png':
                yield (
                    case.name,
                    lambda case=case: (
                        case.load().image,
                        _drawn(read_label_image(case.truth)),
                        1000,
                    ),
                )
            else:
                yield case.name, lambda case=case: (*case.load()[:2], 1)


def _of_8_bits(path: Path) -> tuple[RangeImage, Truth, int]:
    depth = read_label_image(path.with_name(path.name.replace('_truth', '_depth')))
    labels = read_label_image(path)
    (height, width), focal = depth.shape, 518.9 * depth.shape[1] / 640
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    metres = depth.astype(np.float32) * np.float32(10 / 255)
    truth = _drawn(np.where(labels == 255, 0, labels))
    return RangeImage.from_depth(metres, camera), truth, 300


def _drawn(labels: NDArray[np.uint16]) -> Truth:
    """Truth by hand: what has no label was not judged."""
    return as_truth(labels)._replace(judged=labels > 0)


def simulated(command: str, seed: int, scenes: int) -> Path:
    """Folder of what `rangeseg simulate` writes, kept until the simulation changes."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / 'rangeseg_ros' / 'simulation').rglob('*.py')):
        digest.update(path.read_bytes())
    name = re.sub(r'\W+', '-', f'{command} {seed} {scenes} {digest.hexdigest()[:12]}')
    folder = Path(tempfile.gettempdir()) / f'rangeseg-ablate-{name}'
    if not folder.exists():
        given = ['--seed', str(seed), '--scenes', str(scenes), '--output', str(folder)]
        CliRunner().invoke(
            rangeseg, ['simulate', *command.split(), *given], catch_exceptions=False
        )
    return folder


def simulated_frames(
    seed: int, scenes: int, sensors: Sequence[str] = (*ROOMS,)
) -> Iterator[Frame]:
    """Rooms as simulated sensors see them; some also damaged."""
    for sensor in sensors:
        folder = simulated(f'{ROOMS[sensor]} --sensor-seed {seed}', seed, scenes)
        for case in find_cases(folder, 1):
            image, truth, _, planes = case.load()
            frame = Frame('simulated', sensor, image, truth, planes, 1000)
            yield frame
            if sensor in DAMAGED:
                yield from map(frame.damaged, DAMAGES)


def terrain_run(task: TerrainTask, parameters: Mapping[str, Any]) -> Figures:
    """Find the terrain of an image and measure it."""
    begin = time.process_time()
    found = replace(task, config=replace(task.config, **parameters)).run()
    spent = 1e3 * (time.process_time() - begin)
    return {
        'ms': spent,
        **{name.replace('_', ' '): share for name, share in shares(found.pixels).items()},
    }


def track_run(frames: Sequence[Any], parameters: Mapping[str, Any]) -> Figures:
    """Follow the planes of frames (arguments of `Tracker.track`, true labels and faces)."""
    tracker, begin = Tracker(Config(**parameters)), time.process_time()
    tracked = [tracker.track(*frame[:3]) for frame in frames]
    spent = 1e3 * (time.process_time() - begin) / len(frames)
    ids = [
        ids_of_faces(labels, {plane.label: plane.id for plane in planes}, truth, faces)
        for planes, (labels, _, _, truth, faces) in zip(tracked, frames, strict=True)
    ]
    return {'ms': spent, **track_figures(ids)}


def tracked_room(seed: int, count: int = 12) -> list[Any]:
    """A walk through a room and back, segmented, at 5 Hz."""
    scene, frames = kinect_room(seed, 6 * count, walk), []
    for k in range(2 * count):
        view = simulate(scene, Kinect(seed), frame=6 * min(k, 2 * count - 1 - k), seed=seed + k)
        found = Segmenter().segment(RangeImage.from_depth(view.depth, view.camera))
        faces = {plane.label: plane.face for plane in view.planes}
        frames.append((found.labels, found.planes, (k + 5) * 2 * 10**8, view.labels, faces))
    return frames
