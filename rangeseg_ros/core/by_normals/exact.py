"""Every direction expanded, or swapped with every other, at full resolution (thesis 4.8)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.angles import AngularCost
from rangeseg_ros.core.graphcut.moves import Labelling
from rangeseg_ros.core.sensing.grid import Grid


def minimise(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    grid: Grid,
    smoothness: float,
    moves: str = 'expansion',
    cycles: int = 0,
) -> NDArray[np.int32]:
    """Labelling that no move improves, from the nearest direction at every pixel.

    Parameters and result as in `coarse_to_fine.minimise`; `moves` and `cycles` as in
    `Labelling.minimise`.
    """
    cost = AngularCost(normals, directions)
    nearest = cost.nearest().reshape(normals.shape[:2])
    labelling = Labelling(nearest, cost, grid, smoothness)
    labelling.minimise(len(directions), moves, cycles)
    return labelling.image
