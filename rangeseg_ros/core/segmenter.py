"""The pipeline in reading order: range image in, labels and planes out."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals import method as by_normals
from rangeseg_ros.core.by_planes import method as by_planes
from rangeseg_ros.core.by_planes.posterior import plane_probabilities
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane, describe_regions
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.noise import measured_sensor
from rangeseg_ros.core.fitting.steps import jump_steps
from rangeseg_ros.core.ground.survey import Survey
from rangeseg_ros.core.regions import least_pixels, plane_regions, relabel
from rangeseg_ros.core.runtime.kernels import load_lazily, with_kernels
from rangeseg_ros.core.runtime.memory import keep_freed_memory
from rangeseg_ros.core.runtime.work import Stopwatch, step_within
from rangeseg_ros.core.segmentation import Labelling, Segmentation
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.bridges import bridge_holes
from rangeseg_ros.core.sensing.enlargement import Cells, enlargement
from rangeseg_ros.core.sensing.grid import GridEdges, View, weights
from rangeseg_ros.core.sensing.jump_edges import jump_edges
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.core.sensing.sensor import SensorModel


class Segmenter:
    """Segments range images into planes.

    Examples
    --------
    >>> result = Segmenter(Config()).segment(RangeImage.from_depth(depth, camera))
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        keep_freed_memory()
        load_lazily()

    def __repr__(self) -> str:
        changed = (
            f'{f.name}={value!r}'
            for f in fields(self.config)
            if (value := getattr(self.config, f.name)) != f.default
        )
        return f'<Segmenter {", ".join(changed) or "with default parameters"}>'

    def segment(self, image: RangeImage) -> Segmentation:
        """Label every pixel of `image` with the plane it belongs to.

        Raises
        ------
        RangeImageError
            `image` is an array. Or there is a `distortion_map` or a `mask`, and nobody has applied
            it: the core reads no files.
        """
        if not isinstance(image, RangeImage):
            raise RangeImageError(
                f'an image is a RangeImage, not {type(image).__name__}: make one with '
                'RangeImage.from_depth(depth, camera) or RangeImage.from_points(points)'
            )
        return with_kernels(lambda: self._segment(image), self.config, image.camera is None)

    def _segment(self, image: RangeImage) -> Segmentation:
        config, step = self.config, step_within(self.config.work_budget)
        if config.distortion_map and not image.corrected:
            raise RangeImageError(
                'distortion_map is not subtracted yet: segment corrected(image, config)'
            )
        if config.mask and image.body is None:
            raise RangeImageError('mask is not applied yet: segment corrected(image, config)')
        cells = enlargement(image)
        if cells is None and step > 1:
            cells, config = Cells(step, 0, 0), _for_every(step, config)
        if cells is None:
            return self._find_planes(image, config)
        result = self._find_planes(cells.reduced(image), config)
        labels = cells.enlarged(result.labels, image.shape) * image.valid
        counts = np.bincount(labels.ravel(), minlength=len(result.planes) + 1).tolist()
        planes = [plane.named(count=counts[plane.label]) for plane in result.planes]
        return replace(result, labels=labels, planes=planes, image=image, cells=cells)

    def _find_planes(self, image: RangeImage, config: Config) -> Segmentation:
        if config.dithering > 0:
            image = image.dithered(config.dithering, config.seed)
        watch = Stopwatch()
        view, jumps = _preprocessed(image, config, watch)
        labelling: Labelling
        curved: NDArray[np.uint16] | None
        if config.method == 'planes':
            labelling = by_planes.segment(view, config, watch.lap)
            found = labelling.labels
            regions = plane_regions(found, found > 0, view.grid, config.noise_regions, view.least)
            regions, curved, probability, fits = by_planes.flat_regions(
                regions,
                view,
                config.plane_smoothness,
                config.plane_probability,
                config.plane_prior,
            )
            watch.lap('regions')
        else:
            regions, labelling = self._by_normals(view, config, watch)
            curved = None
            # Its labels know no noise: their regions spill by more than a precise sensor errs.
            stated = SensorModel.from_config(config, view.image.shape)
            fits = Fits.of(regions, view.image, stated, view.blocks)
            probability = plane_probabilities(fits, config.plane_prior)
        planes = describe_regions(regions, view.whole, fits, probability)
        # Bridged pixels were not measured, and of some regions no plane is known: a pixel or two,
        # or so steep that they have no end.
        kept = np.zeros(len(fits.theta), np.uint16)
        kept[[plane.label for plane in planes]] = [plane.label for plane in planes]
        labels = relabel(regions, kept) * image.valid
        watch.lap('planes')
        reason = _reason(image, planes)
        survey = Survey.of(image, view.sensor, config)
        upright = config.role_tolerance, config.role_area, config.ground_slope
        others = jumps, survey, upright, config.work_budget
        return Segmentation(
            labels,
            planes,
            watch.laps,
            reason,
            view.sensor,
            labelling,
            *others,
            image,
            curved_regions=curved,
            identified=view.identified,
        )

    def _by_normals(
        self, view: View, config: Config, watch: Stopwatch
    ) -> tuple[NDArray[np.uint16], Labelling]:
        """Regions by discretised normals as labels, and the labelling they are made from."""
        image, grid = view.whole, view.grid
        labelling = by_normals.segment(image, grid, config, watch.lap)
        valid, least = image.valid, view.least
        regions = plane_regions(labelling.labels, valid, grid, config.noise_regions, least)
        watch.lap('regions')
        return regions, labelling


def _for_every(step: int, config: Config) -> Config:
    """Parameters for images of every `step`-th row and column: lengths, areas are in pixels."""
    return replace(
        config,
        min_pixels=-(-config.min_pixels // step**2),
        noise_correlation=config.noise_correlation / step,
        distortion_length=config.distortion_length / step,
        pixel_noise=config.pixel_noise / step,
    )


def _preprocessed(
    image: RangeImage, config: Config, watch: Stopwatch
) -> tuple[View, GridEdges | None]:
    """What is known of an image before planes are looked for, and its jump edges."""
    blocks = Blocks.of(image)
    sensor = stated = SensorModel.from_config(config, image.shape)
    if config.sensor_model == 'measured':
        sensor = measured_sensor(image, blocks, stated)
    identified = config.sensor_model != 'measured' or sensor is not stated
    watch.lap('noise')
    # Method normals tells parallel surfaces apart by jump edges alone, so that one too many on
    # a surface seen at a grazing angle costs it less than one too few.
    grazing = sensor
    if config.method == 'normals':
        grazing = sensor._replace(column_noise=0.0, row_noise=0.0)
    steps = jump_steps(blocks, grazing)
    if config.edge_step > 0:
        given = np.full_like(steps.windows, config.edge_step)
        steps = steps._replace(windows=given, pixels=given)
    # Planes are fitted to what was measured; where they end is found with small holes bridged.
    whole = bridge_holes(image, steps.windows, steps.slopes)
    jumps = jump_edges(whole, config.jump_edges, steps.windows, steps.slopes, steps.pixels)
    grid = weights(whole, jumps, config.weighting)
    watch.lap('edges')
    least = least_pixels(config.min_pixels, image.shape)
    return View(image, whole, blocks, grid, sensor, least, identified), jumps


def _reason(image: RangeImage, planes: list[Plane]) -> str:
    """Why there is no plane; empty when there is one."""
    if planes:
        return ''
    if not image.valid.any():
        return 'no valid depth'
    return 'no flat region large enough'
