"""Method normals from a range image to a labelling (thesis 5.11): labels are directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rangeseg_ros.core.arrays import Ints, Singles
from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.by_normals.labelling import data_costs, minimise, minimise_exactly
from rangeseg_ros.core.by_normals.normals import observed_normals
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.graphcut.expansion import energy, link_costs
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.range_image import RangeImage


@dataclass(frozen=True, eq=False, repr=False)
class Labelling:
    """Discretised normals as labels of the pixels of an image."""

    labels: Ints  # (H, W), indices of directions
    directions: Singles  # (K, 3), unit vectors towards the sensor
    observed: Singles  # (H, W, 3), NaN where undefined
    grid: Grid
    smoothness: float  # lambda

    def normals(self) -> Singles:
        """The reconstructed normals (H, W, 3)."""
        return self.directions[self.labels]

    def energy(self) -> float:
        """Value of eq. 5.3."""
        data = data_costs(self.labels, 1, self.observed, self.directions)
        return energy(data, self.labels, link_costs(self.grid, self.smoothness))


def segment(
    image: RangeImage, grid: Grid, config: Config, lap: Callable[[str], None]
) -> Labelling:
    """Give every pixel a direction; `lap` is told the name of every stage that ends."""
    normals = observed_normals(image, grid, config)
    lap('normals')
    labels_of = (directions(config.direction_count) @ image.axes.T).astype(np.float32)
    minimiser = minimise_exactly if config.exact else minimise
    labels = minimiser(normals, labels_of, grid, config.smoothness)
    lap('labels')
    return Labelling(labels, labels_of, normals, grid, config.smoothness)
