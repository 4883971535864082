"""Method planes from a range image to a labelling, and to the regions that are flat."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.blocks import Nodes, block_size
from rangeseg_ros.core.by_planes.labelling import refine
from rangeseg_ros.core.by_planes.plane_energy import Models, Problem, energy
from rangeseg_ros.core.by_planes.posterior import plane_probabilities
from rangeseg_ros.core.by_planes.surfaces import Patches, join_surfaces, unite_regions
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.regions import drop_regions
from rangeseg_ros.core.runtime.threads import submit
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.grid import View


class Labelling:
    """Planes as labels of the pixels of an image.

    Attributes
    ----------
    labels : (H, W) int32
        0 = no plane.
    """

    def __init__(self, labels: NDArray[np.int32], problem: Problem, models: Models) -> None:
        self.labels = labels
        self._problem = problem
        self._models = models

    def energy(self) -> float:
        """Value of eq. 5.3."""
        return energy(self.labels.ravel(), self._problem, self._models)

    def normals(self) -> None:
        """None: regions have planes, and these their normals."""


def segment(view: View, config: Config, lap: Callable[[str], None]) -> Labelling:
    """Label pixels with planes.

    Parameters
    ----------
    view : View
    config : Config
        `plane_smoothness` is read.
    lap : callable
        Told the name of every stage that ends.
    """
    whole, blocks, grid, sensor = view.whole, view.blocks, view.grid, view.sensor
    size = block_size(whole.shape)
    if size == 2 * BLOCK:
        blocks = blocks.merged(whole.rays, size)
    elif size != BLOCK:
        # With what was bridged: a row of three pixels alone determines no plane.
        blocks = Blocks.of(whole, size)
    nodes = Nodes.of(whole.inverse, grid, blocks, sensor, size)
    lap('blocks')
    smoothness = config.plane_smoothness
    pending = submit(Problem.of, whole, sensor, grid, size, smoothness)
    patches = Patches.of(nodes, size, sensor)
    # Surfaces as large as regions: smaller ones are clutter.
    surface, moments = join_surfaces(
        patches, nodes, size, sensor, smoothness, whole.rays, view.least
    )
    problem = pending.result()
    lap('surfaces')
    labels, models = refine(problem, surface, nodes.moments, moments, sensor)
    lap('labels')
    return Labelling(labels.reshape(whole.shape), problem, models)


def flat_regions(
    regions: NDArray[np.uint16], view: View, smoothness: float, least: float, prior: float
) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.float64], Fits]:
    """Regions (H, W) whose probability to be a plane is not below the `least`, and the others.

    Numbered anew, with the probabilities (M + 1,) and the fits of the first. `prior` is the share
    of planes among regions.
    """
    regions = unite_regions(regions, view.whole, view.grid, view.sensor, smoothness)
    fits = Fits.of(regions, view.image, view.sensor, view.blocks)
    probability = plane_probabilities(fits, prior)
    curved = probability < least
    curved[0] = False
    kept = drop_regions(regions, curved), drop_regions(regions, ~curved)
    return *kept, probability[~curved], fits.without(curved)
