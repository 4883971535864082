"""The pipeline in reading order: range image in, labels and planes out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals import coarse_to_fine
from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.by_normals.normals import observed_normals
from rangeseg_ros.core.by_planes import method as by_planes
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane, described
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.graphcut import moves
from rangeseg_ros.core.graphcut.energy import angle, energy
from rangeseg_ros.core.regions import plane_regions
from rangeseg_ros.core.runtime.memory import keep_freed_memory
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.grid import Grid, weights
from rangeseg_ros.core.sensing.jump_edges import jump_edges
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What was found in one range image.

    Attributes
    ----------
    labels : (H, W) uint16
        0 = no plane, otherwise the label of a plane.
    planes : list of Plane
        In the order of their labels.
    timings : dict
        Milliseconds per stage, in the order of the stages.
    reason : str
        Why there is no plane; empty when there is one.
    """

    labels: NDArray[np.uint16]
    planes: list[Plane]
    timings: dict[str, float]
    reason: str
    _energy: Callable[[], float] = field(repr=False)

    @cached_property
    def energy(self) -> float:
        """Value of eq. 5.3 for the labelling the regions were made from, worked out when read."""
        return self._energy()

    def __getstate__(self) -> dict[str, Any]:
        # With the value of the energy in place of all that it is worked out from.
        return {**self.__dict__, 'energy': self.energy, '_energy': partial(float, self.energy)}


class Segmenter:
    """Segments range images into planes.

    Examples
    --------
    >>> result = Segmenter(Config()).segment(RangeImage.from_depth(depth, camera))
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self._directions = directions(
            self.config.directions, self.config.direction_count, self.config.seed
        )
        self.reset()
        keep_freed_memory()

    def reset(self) -> None:
        """Forget the frame before, from which `warm_start` begins."""
        self._before: tuple[Camera | None, NDArray[np.intp]] | None = None

    def segment(self, image: RangeImage) -> Segmentation:
        """Label every pixel of `image` with the plane it belongs to."""
        config, watch = self.config, Stopwatch()
        if config.dithering > 0:
            image = image.dithered(config.dithering, config.seed)
        grid = weights(image, jump_edges(image, config), config.weighting)
        watch.lap('edges')
        method = self._by_planes if config.method == 'planes' else self._by_normals
        regions, fits, value = method(image, grid, watch)
        planes = described(regions, image, fits)
        watch.lap('planes')
        return Segmentation(regions, planes, watch.laps, _reason(image, planes), value)

    def _by_planes(
        self, image: RangeImage, grid: Grid, watch: Stopwatch
    ) -> tuple[NDArray[np.uint16], Fits, Callable[[], float]]:
        """Regions, their planes and the energy, by planes as labels."""
        labelling = by_planes.segment(image, grid, self.config, watch.lap)
        labels = labelling.labels
        regions = labelling.flat(plane_regions(labels, labels > 0, grid, self.config))
        watch.lap('regions')
        regions, fits = by_planes.united(regions, image, labelling.sensor, grid)
        return regions, fits, labelling.energy

    def _by_normals(
        self, image: RangeImage, grid: Grid, watch: Stopwatch
    ) -> tuple[NDArray[np.uint16], Fits, Callable[[], float]]:
        """The same by discretised normals as labels (thesis 5.11)."""
        config = self.config
        normals = observed_normals(image, *grid, config)
        watch.lap('normals')
        problem = normals, self._directions, *grid, config.smoothness
        if config.exact:
            labels = moves.minimise(*problem, config.cycles, config.moves)
        else:
            labels = coarse_to_fine.minimise(*problem, self._labels_before(image))
            if config.warm_start:
                self._before = image.camera, labels
        watch.lap('labels')
        regions = plane_regions(labels, image.valid, grid, config)
        watch.lap('regions')

        def value() -> float:
            chosen = self._directions.T.astype(np.float32)[:, labels]
            data = angle(np.moveaxis(normals, 2, 0), chosen)
            return energy(data, labels, *grid, config.smoothness)

        return regions, Fits.of(regions, image, SensorModel.from_config(config)), value

    def _labels_before(self, image: RangeImage) -> NDArray[np.intp] | None:
        """Directions of the frame before, if it was taken like this one."""
        if self._before is None:
            return None
        camera, labels = self._before
        return labels if camera == image.camera and labels.shape == image.shape else None


def _reason(image: RangeImage, planes: list[Plane]) -> str:
    """Why there is no plane; empty when there is one."""
    if planes:
        return ''
    if not image.valid.any():
        return 'no valid depth'
    return 'no flat region large enough'


class Stopwatch:
    """Times the stages of a run.

    Attributes
    ----------
    laps : dict
        Milliseconds per stage.
    """

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End the stage that has been running."""
        now = time.perf_counter()
        self.laps[stage] = 1000 * (now - self._last)
        self._last = now
