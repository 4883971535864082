"""Method planes from a range image to a labelling, and to the regions that are flat."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.blocks import Nodes, block_size
from rangeseg_ros.core.by_planes.curvature import find_curved
from rangeseg_ros.core.by_planes.labelling import refine, refine_coarsely
from rangeseg_ros.core.by_planes.plane_energy import Models, Problem, energy
from rangeseg_ros.core.by_planes.surfaces import Patches, join_surfaces
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.fitting.borders import Borders, find_borders
from rangeseg_ros.core.fitting.coplanar import group_coplanar
from rangeseg_ros.core.fitting.first_planes import FirstPlanes
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.regions import by_falling_size, drop_regions, least_pixels, relabel
from rangeseg_ros.core.runtime.threads import submit
from rangeseg_ros.core.runtime.work import Work
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel


class Labelling:
    """Planes as labels of the pixels of an image.

    Attributes
    ----------
    labels : (H, W) int32
        0 = no plane.
    sensor : SensorModel
        The errors that the image shows.
    """

    def __init__(
        self,
        labels: NDArray[np.int32],
        sensor: SensorModel,
        problem: Problem,
        models: Models,
    ) -> None:
        self.labels = labels
        self.sensor = sensor
        self._problem = problem
        self._models = models

    def energy(self) -> float:
        """Value of eq. 5.3."""
        return energy(self.labels.ravel(), self._problem, self._models)

    def normals(self) -> None:
        """None: regions have planes, and these their normals."""


def segment(
    image: RangeImage,
    blocks: Blocks,
    grid: Grid,
    sensor: SensorModel,
    config: Config,
    lap: Callable[[str], None],
) -> Labelling:
    """Label every pixel with a plane.

    Parameters
    ----------
    image : RangeImage
        (H, W), holes bridged.
    blocks : Blocks
        Of 4 x 4 pixels, without what was bridged.
    grid : Grid
        Of the image.
    sensor : SensorModel
        Errors of the image.
    config : Config
        `plane_smoothness`, `min_pixels`, `exact`, `refits` and `work_budget` are read.
    lap : callable
        Told the name of every stage that ends.
    """
    size = block_size(image.shape)
    if size == 2 * BLOCK:
        blocks = blocks.merged(image.rays, size)
    elif size != BLOCK:
        # With what was bridged: a row of three pixels alone determines no plane.
        blocks = Blocks.of(image, size)
    nodes = Nodes.of(image.inverse, grid, blocks, sensor, size)
    lap('blocks')
    patches = Patches.of(nodes, size, sensor)
    smoothness = config.plane_smoothness
    pending = submit(Problem.of, image, sensor, grid, size, smoothness)
    # Where neighbours repeat each other, one pixel of four tells more than half of what they do.
    coarsely = sensor.patch > 2 and size >= BLOCK and not (config.exact or config.refits)
    coarse = submit(every_second, image, sensor, grid, size, smoothness) if coarsely else None
    # Surfaces as large as regions: smaller ones are clutter.
    least = least_pixels(config.min_pixels, image.shape)
    surface, moments = join_surfaces(patches, nodes, size, sensor, smoothness, least)
    problem = pending.result()
    lap('surfaces')
    cuts = Work.within(config.work_budget).cuts
    found = surface, nodes.moments, moments, sensor
    if coarse is None:
        labels, models = refine(problem, *found, config.exact, config.refits, cuts)
    else:
        labels, models = refine_coarsely(problem, coarse.result(), *found, cuts)
    lap('labels')
    return Labelling(labels.reshape(image.shape), sensor, problem, models)


def every_second(
    image: RangeImage, sensor: SensorModel, grid: Grid, block: int, smoothness: float
) -> Problem:
    """What every second pixel of every second row has to explain.

    A quarter of the data, and borders of half as many pixels, of which each costs half: the energy
    of all pixels (thesis eq. 5.3), a quarter of it.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    sensor : SensorModel
        Errors of the image.
    grid : Grid
        Of the image.
    block : int
        Rows and columns of its blocks, even.
    smoothness : float
        `plane_smoothness`.
    """
    coarser = sensor.magnified(1 / 2)
    smoothness *= sensor.patch / coarser.patch / 2
    problem = Problem.of(image.every(2), coarser, grid.every(2), block // 2, smoothness)
    return problem._replace(smooth=sensor.distortion_pixels)


def flat_regions(
    regions: NDArray[np.uint16],
    image: RangeImage,
    blocks: Blocks,
    sensor: SensorModel,
    grid: Grid,
    flatness: float,
) -> tuple[NDArray[np.uint16], FirstPlanes, Borders]:
    """Regions (H, W) without those that bend, numbered anew, their first planes and borders.

    See `find_curved`.
    """
    pending = submit(find_borders, regions, grid, int(regions.max()) + 1)
    first = FirstPlanes.of(regions, image, blocks, sensor)
    borders = pending.result()
    curved = find_curved(regions, first, borders, image, blocks, sensor, flatness)
    flat = submit(drop_regions, regions, curved)
    others = first.without(curved), borders.without(curved)
    return flat.result(), *others


def unite_regions(
    regions: NDArray[np.uint16],
    first: FirstPlanes,
    borders: Borders,
    image: RangeImage,
    blocks: Blocks,
    sensor: SensorModel,
) -> tuple[NDArray[np.uint16], Fits]:
    """Unite regions that touch and whose planes agree; the regions and their planes.

    Parameters
    ----------
    regions : (H, W) uint16
        0...M.
    first : FirstPlanes
        Of the regions.
    borders : Borders
        Of the regions.
    image : RangeImage
        (H, W).
    blocks : Blocks
        Of the image.
    sensor : SensorModel
    """
    count = len(first.theta)
    fits = Fits.of(regions, image, sensor, blocks, first, borders)
    group = group_coplanar(fits, borders, sensor.agreement)
    if (group == np.arange(count)).all():
        return regions, fits
    pixels = np.zeros(count, np.intp)
    np.add.at(pixels, group, fits.pixels)
    pixels[0] = 0
    table = by_falling_size(pixels)[group]
    united = submit(relabel, regions, table)
    fits = fits.united(table, image.camera is not None)
    return united.result(), fits
