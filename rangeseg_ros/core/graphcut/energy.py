"""The energy that both methods minimise: E(f) = sum_p D_p(f_p) + lambda sum_pq u_pq [f_p != f_q].

D_p is the data cost of each method: `by_normals.angular_cost`, `by_planes.plane_energy`. The other
sum is the Potts prior over the 4-connected grid, with the neighbourhood weights u of `Grid`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.grid import Grid


def energy(
    data: NDArray[np.floating], labels: NDArray[np.integer], grid: Grid, smoothness: float
) -> float:
    """Value of E for labels (H, W) of data costs (H, W), lambda = `smoothness`."""
    across = grid.right[labels[:, 1:] != labels[:, :-1]]
    down = grid.below[labels[1:] != labels[:-1]]
    boundary = across.sum(dtype=float) + down.sum(dtype=float)
    return float(data.sum(dtype=float) + smoothness * boundary)


def link_costs(grid: Grid, smoothness: float) -> NDArray[np.float32]:
    """Lambda u of every edge of a grid (H, W), in the order of the sites; lambda = `smoothness`.

    (2, H * W): of each pixel's edges to the right and down, 0 at the border. The edge between p
    and its neighbour q on side k (0 right, 1 down, 2 left, 3 up) is [k % 2, min(p, q)]; before the
    first pixel, where this counts from the end, is a border as well.
    """
    height, width = len(grid.right), grid.below.shape[1]
    result = np.empty((2, height, width), np.float32)
    result[0, :, -1] = result[1, -1] = 0
    np.multiply(grid.right, np.float32(smoothness), out=result[0, :, :-1], casting='same_kind')
    np.multiply(grid.below, np.float32(smoothness), out=result[1, :-1], casting='same_kind')
    return result.reshape(2, -1)
