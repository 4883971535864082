"""Method planes: from the view of an image to a labelling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rangeseg_ros.core.arrays import Ints
from rangeseg_ros.core.by_planes.labelling import refine
from rangeseg_ros.core.by_planes.patches import Nodes, find_patches
from rangeseg_ros.core.by_planes.plane_energy import Models, Problem, costs
from rangeseg_ros.core.by_planes.surfaces import join_surfaces
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.graphcut.expansion import energy
from rangeseg_ros.core.runtime.threads import Task
from rangeseg_ros.core.sensing.grid import View


@dataclass(frozen=True, eq=False, repr=False)
class Labelling:
    """Planes, those of `models`, as labels (H, W) of the pixels of an image; 0 is no plane."""

    labels: Ints
    problem: Problem
    models: Models

    def energy(self) -> float:
        """Value of eq. 5.3."""
        data = costs(self.labels.ravel(), self.problem, self.models)
        return energy(data.reshape(self.labels.shape), self.labels, self.problem.links)

    def normals(self) -> None:
        """None: regions have planes, and these their normals."""


def segment(view: View, config: Config, lap: Callable[[str], None]) -> Labelling:
    """Label pixels with planes; `lap` is told the name of every stage that ends."""
    whole, sensor = view.whole, view.sensor
    nodes = Nodes.of(view)
    lap('blocks')
    smoothness = config.plane_smoothness
    patches = find_patches(nodes, sensor)
    begun = Task(Problem.of, whole, sensor, view.grid, smoothness)
    surface, moments = join_surfaces(*patches, nodes, view, smoothness)
    problem = begun.result()
    lap('surfaces')
    labels, models = refine(problem, surface, nodes.moments, moments, sensor)
    lap('labels')
    return Labelling(labels.reshape(whole.shape), problem, models)
