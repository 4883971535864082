"""Method normals from a range image to a labelling (thesis 5.11): labels are directions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals import coarse_to_fine
from rangeseg_ros.core.by_normals.angles import AngularCost, angle
from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.by_normals.normals import observed_normals
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.graphcut import moves as graphcut
from rangeseg_ros.core.graphcut.energy import energy
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.range_image import RangeImage


class Labelling:
    """Discretised normals as labels of the pixels of an image.

    Attributes
    ----------
    labels : (H, W) integer
        Numbers of directions.
    directions : (K, 3) float64
        Unit vectors towards the sensor.
    """

    def __init__(
        self,
        labels: NDArray[np.integer],
        directions: NDArray[np.float64],
        normals: NDArray[np.float32],
        grid: Grid,
        smoothness: float,
    ) -> None:
        self.labels = labels
        self.directions = directions
        self._normals = normals
        self._grid = grid
        self._smoothness = smoothness

    def normals(self) -> NDArray[np.float32]:
        """The reconstructed normals (H, W, 3)."""
        return self.directions.astype(np.float32)[self.labels]

    def energy(self) -> float:
        """Value of eq. 5.3."""
        data = angle(np.moveaxis(self._normals, 2, 0), np.moveaxis(self.normals(), 2, 0))
        return energy(data, self.labels, self._grid, self._smoothness)


def segment(
    image: RangeImage,
    grid: Grid,
    config: Config,
    lap: Callable[[str], None],
) -> Labelling:
    """Give every pixel a direction.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    grid : Grid
        Of the image.
    config : Config
        All that is said to be of method normals is read.
    lap : callable
        Told the name of every stage that ends.
    """
    normals = observed_normals(image, grid, config)
    lap('normals')
    labels_of = directions(config.directions, config.direction_count, config.seed)
    labels_of = labels_of @ image.axes.T
    problem = normals, labels_of, grid, config.smoothness
    if config.exact:
        labels = minimise_exactly(*problem, config.moves, config.cycles)
    else:
        labels = coarse_to_fine.minimise(*problem)
    lap('labels')
    return Labelling(labels, labels_of, normals, grid, config.smoothness)


def minimise_exactly(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    grid: Grid,
    smoothness: float,
    moves: str = 'expansion',
    cycles: int = 0,
) -> NDArray[np.int32]:
    """Labelling that no move of a label improves, from the nearest direction at every pixel.

    Parameters and result as in `coarse_to_fine.minimise`; `moves` and `cycles` as in
    `moves.Labelling.minimise` (thesis 4.8).
    """
    cost = AngularCost(normals, directions)
    nearest = cost.nearest().reshape(normals.shape[:2])
    labelling = graphcut.Labelling(nearest, cost, grid, smoothness)
    labelling.minimise(len(directions), moves, cycles)
    return labelling.image
