"""The pipeline in reading order: range image in, labels and planes out."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from rangeseg_ros.core.arrays import Labels
from rangeseg_ros.core.by_normals import method as by_normals
from rangeseg_ros.core.by_planes import method as by_planes
from rangeseg_ros.core.by_planes.borders import with_sharp_borders
from rangeseg_ros.core.by_planes.posterior import calibrated, plane_posteriors
from rangeseg_ros.core.by_planes.surfaces import unite_regions
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import describe_regions
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.noise import measured_sensor, nested, quantisation
from rangeseg_ros.core.fitting.region_sums import sum_regions
from rangeseg_ros.core.fitting.steps import jump_steps
from rangeseg_ros.core.ground.ground_input import GroundInput
from rangeseg_ros.core.options import ConfigError
from rangeseg_ros.core.regions import least_pixels, numbers_of, plane_regions, relabel
from rangeseg_ros.core.runtime.kernels import with_kernels
from rangeseg_ros.core.runtime.threads import Task
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.binning import Bins, bin_side
from rangeseg_ros.core.sensing.blocks import NODE, Blocks
from rangeseg_ros.core.sensing.bridges import bridge_holes
from rangeseg_ros.core.sensing.encoding import decoded, encoding
from rangeseg_ros.core.sensing.enlargement import Cells, enlargement
from rangeseg_ros.core.sensing.grid import GridEdges, View, grid_of
from rangeseg_ros.core.sensing.jump_edges import jump_edges
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.core.sensing.sensor import SensorModel

# What is begun of an image: its bins, and nested blocks of these.
BinsTask = Task[tuple[Bins, list[Blocks]]]


class Stopwatch:
    """Times the stages of a run; `laps` are milliseconds per stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End the stage that has been running."""
        now = time.perf_counter()
        self.laps[stage] = 1000 * (now - self._last)
        self._last = now


class Segmenter:
    """Segments range images into planes.

    Examples
    --------
    >>> result = Segmenter(Config()).segment(RangeImage.from_depth(depth, camera))
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = Config() if config is None else config
        if not isinstance(self.config, Config):
            raise ConfigError(f'config must be a Config(...), not {config!r:.60}')

    def __repr__(self) -> str:
        return f'Segmenter({self.config!r})'

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
        config = self.config
        if config.distortion_map and not image.corrected:
            raise RangeImageError(
                'distortion_map is not subtracted yet: segment corrected(image, config)'
            )
        if config.mask and image.body is None:
            raise RangeImageError('mask is not applied yet: segment corrected(image, config)')
        # Begun before it is known whether the values are those of depth.
        begun = Task(_binned, image, self._side(image))
        if (q := encoding(image)) is not None:
            depth = decoded(image, q)
            result = self._segment_cells(depth, enlargement(depth))
            # Heights in no unit are no ground to drive on.
            return replace(
                result, image=image, values='picture' if q else 'disparity', source=None
            )
        return self._segment_cells(image, enlargement(image), begun)

    def _segment_cells(
        self, image: RangeImage, cells: Cells | None, begun: BinsTask | None = None
    ) -> Segmentation:
        """Segment an image whose measurements fill `cells` of pixels, or one pixel each (None)."""
        config = self.config
        if cells is None:
            result = self._find_planes(image, begun)
            return replace(result, source=GroundInput.of(image, result.sensor, config))
        result = self._find_planes(cells.reduced(image))
        source = replace(GroundInput.of(image, result.sensor, config), cells=cells)
        labels = cells.enlarged(result.labels, image.shape) * image.valid
        squares = cells._replace(factor=cells.factor * result.side)
        sensor = result.sensor.rescaled(1 / cells.factor)
        return replace(result.of_pixels(labels, image, squares), source=source, sensor=sensor)

    def _side(self, image: RangeImage) -> int:
        """Pixels along the side of a bin: directions are told from pixels."""
        planes = self.config.method == 'planes'
        return bin_side(image.shape, self.config.work_budget) if planes else 1

    def _find_planes(self, image: RangeImage, begun: BinsTask | None = None) -> Segmentation:
        """Planes of the bins of an image, and labels of its pixels."""
        config, watch = self.config, Stopwatch()
        side = self._side(image)
        if config.dithering > 0:
            image, begun = image.dithered(config.dithering, config.seed), None
        begun = begun or Task(_binned, image, side)
        view, sensor, jumps, blocks = _preprocessed(image, config, begun, watch)
        labelling: by_planes.Labelling | by_normals.Labelling
        if config.method == 'planes':
            labelling = by_planes.segment(view, config, watch.lap)
            valid, errors = labelling.labels > 0, view.sensor
        else:
            labelling = by_normals.segment(view.whole, view.grid, config, watch.lap)
            # Regions of normals spill over edges by more than the measured errors: use the stated.
            valid, errors = view.whole.valid, SensorModel.from_config(config, image.shape)
        regions = plane_regions(labelling.labels, valid, view.grid, view.min_pixels)
        # Unite parts of a plane that holes separate, or that got two neighbouring directions.
        sums = sum_regions(regions, view.image, blocks.result(), errors)
        regions, pairs, sums = unite_regions(regions, sums, view, config.plane_smoothness)
        fits = Fits.of(sums, errors, image.camera is None)
        posterior = Task(plane_posteriors, fits, pairs)
        pixels: Task[Labels] | None = None
        if isinstance(labelling, by_planes.Labelling) and side > 1:
            given = regions, labelling.labels, labelling.models, image, side, sensor
            pixels = Task(
                with_sharp_borders, *given, config.plane_smoothness * sensor.pixel_inflation
            )
        roots, probability = fits.roots(), calibrated(posterior.result())
        # Method normals drops no region.
        flat = (probability >= config.plane_probability) | (config.method == 'normals')
        flat[0] = True
        numbers = numbers_of(flat)
        curved = None if config.method == 'normals' else relabel(regions, numbers_of(~flat))
        fits, roots = fits.without(~flat), roots[flat]
        watch.lap('regions')
        # No labels on bridged pixels, nor on regions without a plane or with one up to infinity.
        names = (fits.farthest() > 0)[numbers] * numbers
        found = Task(lambda: relabel(pixels.result() if pixels else regions * image.valid, names))
        errors = sensor if pixels else errors
        described = fits, roots, errors, probability[flat]
        planes = describe_regions(relabel(regions, numbers), view.whole, *described)
        labels = found.result()
        known = labels, planes, watch.laps, '', sensor, labelling, jumps
        result = Segmentation(
            *known,
            upright=(config.role_tolerance, config.role_area, config.ground_slope),
            work_budget=config.work_budget,
            image=image,
            curved_regions=curved,
            identified=view.identified,
        )
        if pixels:
            result = result.of_pixels(labels, image, Cells(side, 0, 0))
        watch.lap('planes')
        return result if result.planes else replace(result, reason=_reason(image))


def _binned(image: RangeImage, side: int) -> tuple[Bins, list[Blocks]]:
    """Bins of an image, and nested blocks of these."""
    bins = Bins.of(image, side)
    return bins, nested(bins.means)


def _preprocessed(
    image: RangeImage, config: Config, begun: BinsTask, watch: Stopwatch
) -> tuple[View, SensorModel, GridEdges | None, Task[Blocks]]:
    """What is known of an image's bins before planes are looked for.

    And the errors of its pixels, the jump edges between bins, and blocks of 4 x 4 bins.
    """
    measured, planes = config.sensor_model == 'measured', config.method == 'planes'
    quanta = quantisation(image.inverse) if measured else None
    bins, scales = begun.result()
    side, nodes = bins.side, Task(Blocks.of, bins.means, NODE) if planes else None
    least = -(-least_pixels(config.min_pixels, image.shape) // side**2)
    stated = SensorModel.from_config(config, image.shape).binned(side)
    sensor = measured_sensor(scales, stated, quanta) if quanta else stated
    identified = not measured or sensor is not stated
    watch.lap('noise')
    # Method normals tells parallel surfaces apart by jump edges alone, so that one too many on
    # a surface seen at a grazing angle costs it less than one too few.
    grazing = sensor if planes else sensor._replace(direction_noise=0.0)
    steps = jump_steps(scales[0], grazing)
    if config.edge_step > 0:
        given = np.full_like(steps.windows, config.edge_step)
        steps = steps._replace(windows=given, pixels=given)
    excess = bins.noise_of_pixels(sensor)
    if side > 1:
        image = bins.of_one_surface(steps.pixels * np.float32(excess**0.5))
    # Planes are fitted to what was measured; where they end is found with small holes bridged,
    # which bins of several pixels do not have.
    whole = bridge_holes(image, steps.windows, steps.slopes) if side == 1 else image
    if nodes:
        nodes = Task(nodes.result().updated, bins.means, whole, NODE)
    jumps = jump_edges(whole, config.jump_edges, steps.windows, steps.slopes, steps.pixels)
    blocks = Task(scales[0].updated, bins.means, image)
    grid = grid_of(whole, jumps)
    watch.lap('edges')
    known = grid, sensor, least, bins.area, identified, nodes.result() if nodes else None
    return View(image, whole, *known), sensor.of_pixels(side, excess), jumps, blocks


def _reason(image: RangeImage) -> str:
    """Why there is no plane in an image."""
    if not image.valid.any():
        return 'no valid depth' if image.body is None else 'no valid depth outside the mask'
    return 'no flat region large enough'
