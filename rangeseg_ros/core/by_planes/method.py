"""Method planes from a range image to a labelling, and to the regions that are flat."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.blocks import Nodes, block_size
from rangeseg_ros.core.by_planes.labelling import refine
from rangeseg_ros.core.by_planes.plane_energy import Models, Problem, energy
from rangeseg_ros.core.by_planes.posterior import plane_probabilities
from rangeseg_ros.core.by_planes.surfaces import Patches, join_surfaces
from rangeseg_ros.core.by_planes.upsampling import labels_of_all
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.regions import drop_regions
from rangeseg_ros.core.runtime.threads import submit
from rangeseg_ros.core.runtime.work import Work
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.view import View


class Labelling:
    """Planes as labels of the pixels of an image.

    Attributes
    ----------
    labels : (H, W) int32
        0 = no plane.
    """

    def __init__(
        self,
        labels: NDArray[np.int32],
        problem: Problem,
        models: Models,
        view: View,
        smoothness: float,
    ) -> None:
        self.labels = labels
        self._problem = problem
        self._models = models
        # Of all pixels, where the labels are of every second one.
        self._view = view
        self._smoothness = smoothness

    def energy(self) -> float:
        """Value of eq. 5.3 for all pixels, those left out with the labels of `labels_of_all`."""
        labels, problem, view = self.labels, self._problem, self._view
        if problem.step > 1:
            size, sensor = problem.block * problem.step, view.sensor
            few, planes = labels.astype(np.uint16), (self._models.theta, sensor)
            pixels = view.image, view.whole, *planes, self._smoothness * sensor.patch
            labels = labels_of_all(few, problem.step, *pixels)[0].astype(np.int32)
            problem = Problem.of(view.whole, sensor, view.grid, size, self._smoothness)
        return energy(labels.ravel(), problem, self._models)

    def normals(self) -> None:
        """None: regions have planes, and these their normals."""


def segment(view: View, config: Config, lap: Callable[[str], None]) -> tuple[Labelling, View]:
    """Label pixels with planes.

    Parameters
    ----------
    view : View
    config : Config
        `plane_smoothness`, `exact`, `refits` and `work_budget` are read.
    lap : callable
        Told the name of every stage that ends.

    Returns
    -------
    labelling : Labelling
        Of the pixels of the view that follows.
    seen : View
        The one given. Where neighbours repeat each other, so that one pixel of four tells more
        than half of what they do, every second one of every second row, unless `exact` or `refits`
        ask for all. (Of graph cuts at several resolutions: Lombaert et al., A multilevel banded
        graph cuts method, ICCV 2005.)
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
    patches = Patches.of(nodes, size, sensor)
    smoothness = config.plane_smoothness
    thorough = config.exact or config.refits > 0
    step = 2 if sensor.patch > 2 and size >= BLOCK and not thorough else 1
    pending = submit(_posed, view, step, size, smoothness)
    # Surfaces as large as regions: smaller ones are clutter.
    surface, moments = join_surfaces(patches, nodes, size, sensor, smoothness, view.least)
    seen, problem = pending.result()
    lap('surfaces')
    cuts = Work.within(config.work_budget).cuts
    labels, models = refine(
        problem, surface, nodes.moments, moments, sensor, config.exact, config.refits, cuts
    )
    lap('labels')
    labels = labels.reshape(seen.image.shape)
    return Labelling(labels, problem, models, view, smoothness), seen


def _posed(view: View, step: int, block: int, smoothness: float) -> tuple[View, Problem]:
    """Every `step`-th pixel of every such row, and what they have to explain."""
    seen = view.every(step) if step > 1 else view
    grid, block = seen.grid, block // step
    return seen, Problem.of(seen.whole, view.sensor, grid, block, smoothness, step)


def flat_regions(
    regions: NDArray[np.uint16], view: View, least: float, prior: float
) -> tuple[NDArray[np.uint16], NDArray[np.float64], Fits]:
    """Regions (H, W) whose probability to be a plane is not below the `least`, numbered anew.

    With these probabilities (M + 1,), and their fits. `prior` is the share of planes among
    regions.
    """
    fits = Fits.of(regions, view.image, view.sensor, view.blocks)
    probability = plane_probabilities(fits, prior)
    curved = probability < least
    curved[0] = False
    return drop_regions(regions, curved), probability[~curved], fits.without(curved)
