"""Terrain measured against the truth of simulated scenes: files, shares, tables."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Mask
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.evaluation.label_files import EvaluationError, read_label_image
from rangeseg_ros.evaluation.stairs import StairsCheck, check_stairs, stairs_figures, stairs_line
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.io.images import read_depth, write_image
from rangeseg_ros.io.tables import write_table
from rangeseg_ros.simulation.terrain.scene import Terrain

REACH = {'realsense': 2.5}
"""Metres up to which a sensor's ground and obstacles count; 3.5 for all others."""
MARGIN = 3
"""Pixels beside borders of classes that do not count."""
SIZES = (0.05, 0.075, 0.11, 0.2, 0.4)
"""Heights of obstacles that the table tells apart, metres."""
CONFIDENCES = (0.0, 0.5, 0.9, 0.99, 0.999, 1.01)
"""Between which images are counted together."""
_COLUMNS = ('name', 'kind', 'sensor', 'up_x', 'up_y', 'up_z', 'sensor_height')
_STAIRS = ('direction', 'count', 'rise', 'run')
_DEPTHS = (('depth', 'png'), ('size', 'tiff'), ('crossing', 'tiff'), ('height', 'tiff'))


def write_terrains(
    path: Path, images: Iterable[tuple[str, str, Terrain, tuple[Floats, float]]]
) -> None:
    """Write the CSV of images: name, sensor, scene, and up and height as the robot knows them."""
    rows = []
    for name, sensor, scene, (up, height) in images:
        known = [f'{value:.6f}' for value in (*up, height)]
        stairs = [scene.stairs.get(column, '') for column in _STAIRS]
        rows.append([name, scene.kind, sensor, *known, *stairs])
    write_table(path, (*_COLUMNS, *_STAIRS), rows)


class Shares(NamedTuple):
    """What became of the pixels of one image: (4, 4) by true and found class.

    `obstacles` (2, len(SIZES), 4) are pixels of obstacles by height and distance in whole metres,
    and those that were found. `confidence` is that the ground seen is the one that the robot
    stands on; `own`, whether it is: by most of the pixels called ground or, if there are none, of
    the nearest hundredth.
    """

    name: str
    kind: str
    pixels: NDArray[np.int64]
    obstacles: Floats
    stairs: StairsCheck
    confidence: float = 0.0
    own: bool = False


@dataclass(frozen=True)
class TerrainTask:
    """An image with its row of the table, and the parameters to find the terrain with.

    Pictures go to the folder `output`: truth, what was found, and where they differ.
    """

    folder: Path
    row: dict[str, str]
    config: Config
    output: Path | None = None

    @property
    def picture(self) -> Path:
        """Where the picture of the image is left."""
        kind = self.row['kind'].replace(' ', '_')
        return (self.output or Path()) / f'{self.row["name"]}_{kind}.png'

    def run(self) -> Shares:
        """Segment the image and count its pixels."""
        name, reach = self.row['name'], REACH.get(self.row['sensor'], 3.5)
        camera = read_camera(self.folder / 'camera.yaml')
        truth = _read_truth(self.folder / 'truth' / f'{name}.png', camera.shape)
        depth, size, crossing, height = (
            read_depth(self.folder / part / f'{name}.{suffix}', camera.shape)
            for part, suffix in _DEPTHS
        )
        image = RangeImage.from_depth(depth, camera)
        result = Segmenter(self.config).segment(corrected(image, self.config))
        found, stairs = result.terrain, check_stairs(self.row, height, result.stairs)
        metres = np.where(truth == DROP, crossing, depth / 1000)
        judged = (truth > UNKNOWN) & (metres <= reach) & ~_near_borders(truth)
        pixels = np.zeros((4, 4), np.int64)
        np.add.at(pixels, (truth[judged], found[judged]), 1)
        obstacle = judged & (truth == OBSTACLE)
        bins = [(*SIZES, np.inf), range(5)]
        obstacles = np.stack(
            [
                np.histogram2d(size[some] + 1e-6, metres[some], bins)[0]
                for some in (obstacle, obstacle & (found == OBSTACLE))
            ]
        )
        confidence = result.ground.stand.confidence if result.ground else 0.0
        limit = np.quantile(metres[judged], 0.01) if judged.any() else 0.0
        called = judged & (found == GROUND)
        surface = called if called.any() else judged & (metres <= limit)
        own = bool(np.count_nonzero(truth[surface] == GROUND) * 2 > np.count_nonzero(surface))
        if self.output:
            wrong = judged & (found != truth)
            picture = np.hstack([_COLOURS[truth], _COLOURS[found], _COLOURS[found * wrong]])
            write_image(self.picture, picture)
        return Shares(name, self.row['kind'], pixels, obstacles, stairs, confidence, own)


def _read_truth(path: Path, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """True classes (H, W); EvaluationError where they are no classes, or of another size."""
    truth = read_label_image(path)
    if truth.shape != shape:
        sizes = ('x'.join(map(str, pair[::-1])) for pair in (truth.shape, shape))
        raise EvaluationError('{}: truth is {}, its camera {}'.format(path, *sizes))
    if truth.max(initial=0) > DROP:
        raise EvaluationError(f'{path}: {truth.max()} is no class of terrain (0 to {DROP})')
    return truth.astype(np.uint8)


_COLOURS = np.array([[0, 0, 0], [0, 150, 0], [220, 0, 0], [0, 0, 240]], np.uint8)


def _near_borders(truth: NDArray[np.uint8]) -> Mask:
    """(H, W) whether another judged class is within `MARGIN` pixels."""
    kernel = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
    highest = cv2.dilate(truth, kernel)
    lowest = cv2.erode(np.where(truth == UNKNOWN, 255, truth).astype(np.uint8), kernel)
    result: Mask = highest != lowest
    return result


def terrain_tasks(
    folder: Path, config: Config, know_height: bool, output: Path | None
) -> list[TerrainTask]:
    """A task for each image of `rangeseg simulate terrain`; EvaluationError of a malformed table.

    `up_x`, `up_y`, `up_z` and, if it shall be known, `sensor_height` are those of the images.
    """
    path = folder / 'terrain.csv'
    tasks = []
    with path.open(newline='') as file:
        try:
            for row in csv.DictReader(file):
                if not all(row[name] for name in _COLUMNS):
                    raise ValueError
                known: dict[str, Any] = {name: float(row[name]) for name in _COLUMNS[3:]}
                if not know_height:
                    known['sensor_height'] = 0.0
                tasks.append(TerrainTask(folder, dict(row), replace(config, **known), output))
            if not tasks:
                raise ValueError
        except (KeyError, TypeError, ValueError, csv.Error):
            raise EvaluationError(f'{path}: malformed table of terrains') from None
    return tasks


def shares(pixels: NDArray[np.int64]) -> dict[str, float]:
    """Of the true ground, obstacles and drops, what they were called; NaN where there are none."""
    with np.errstate(invalid='ignore'):
        share = pixels / pixels.sum(axis=1, keepdims=True)
    return {
        'ground_kept': float(share[GROUND, GROUND]),
        'ground_called_obstacle': float(share[GROUND, OBSTACLE]),
        'ground_called_drop': float(share[GROUND, DROP]),
        'obstacle_found': float(share[OBSTACLE, OBSTACLE]),
        'obstacle_called_ground': float(share[OBSTACLE, GROUND]),
        'drop_found': float(share[DROP, DROP]),
        'drop_called_ground': float(share[DROP, GROUND]),
    }


def terrain_figures(images: Sequence[Shares]) -> dict[str, Any]:
    """Shares over all pixels of all images, of each kind of scene, and of each image."""
    kinds = sorted({image.kind for image in images})
    return {
        'images': len(images),
        'pooled': shares(_pooled(images)),
        'by_kind': {kind: shares(_pooled(i for i in images if i.kind == kind)) for kind in kinds},
        'by_size': _by_size(images),
        'reliability': _reliability(images),
        'stairs': stairs_figures([image.stairs for image in images]),
        'per_image': {i.name: {'kind': i.kind, **shares(i.pixels)} for i in images},
        'drop_scenes_above_0.01': [
            i.name for i in images if shares(i.pixels)['drop_called_ground'] > 0.01
        ],
    }


def _pooled(images: Iterable[Shares]) -> NDArray[np.int64]:
    return sum((image.pixels for image in images), np.zeros((4, 4), np.int64))


def _reliability(images: Sequence[Shares]) -> list[dict[str, float]]:
    """Of images by their confidence, how often the ground seen is the robot's own."""
    rows = []
    for low, high in pairwise(CONFIDENCES):
        stated = np.array([(i.confidence, i.own) for i in images if low <= i.confidence < high])
        if len(stated):
            mean, right = stated.mean(axis=0).tolist()
            rows.append({'from': low, 'images': len(stated), 'confidence': mean, 'right': right})
    return rows


def _by_size(images: Sequence[Shares]) -> dict[str, dict[str, float]]:
    """Share of the pixels of obstacles that were found, by height and distance."""
    there, found = sum((i.obstacles for i in images), np.zeros((2, len(SIZES), 4)))
    with np.errstate(invalid='ignore'):
        shares = (found / there).tolist()
    return {
        f'{least:g}': {f'{metre}': share for metre, share in enumerate(row)}
        for least, row in zip(SIZES, shares, strict=True)
    }


def terrain_table(figures: Mapping[str, Any]) -> str:
    """Text of `terrain_figures`: shares of the kinds of scenes and of all, obstacles by height."""
    heads = ('kept', 'obstacle', 'drop', 'found', 'ground', 'found', 'ground')
    lines = [
        ' ' * 18 + '|         ground            |     obstacle     |       drop',
        f'{"called":<18}' + ''.join(f'{head:>9}' for head in heads),
    ]
    for kind, row in {**figures['by_kind'], 'all': figures['pooled']}.items():
        lines.append(f'{kind:<18}' + ''.join(f'{_share(value):>9}' for value in row.values()))
    lines.append(f'drop called ground above 0.01: {len(figures["drop_scenes_above_0.01"])} scenes')
    rates = (
        f'{row["confidence"]:.3f}: {row["right"]:.3f} of {row["images"]}'
        for row in figures['reliability']
    )
    lines.append(f'confidence in the ground, and how often it was right: {", ".join(rates)}')
    lines.append('obstacles found, from this height (m) on, at 0, 1, 2, 3 m:')
    for least, row in figures['by_size'].items():
        lines.append(f'{least:<18}' + ''.join(f'{_share(value):>9}' for value in row.values()))
    return '\n'.join([*lines, stairs_line(figures['stairs'])])


def _share(value: float) -> str:
    return '-' if np.isnan(value) else f'{value:.4f}'
