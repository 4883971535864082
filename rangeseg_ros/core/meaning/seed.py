"""What the ground is grown from: its surface where that comes into view."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.under_robot import NEAR, solve_plane

# Cells that tell its plane.
_PLENTY = 300


@njit(cache=True, nogil=True)
def nearest_part(
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    surface: NDArray[np.int32],
    chosen: int,
    tolerance: float,
) -> NDArray[np.bool_]:
    """Cells of a surface nearest to the robot that lie on one plane."""
    rows, columns = surface.shape
    nearest = np.inf
    for i in range(rows):
        for c in range(columns):
            if surface[i, c] == chosen:
                nearest = min(nearest, place[1, i, c] ** 2 + place[2, i, c] ** 2)
    # It is grown from what is near to where it comes into view.
    reach = (np.sqrt(nearest) + NEAR) ** 2
    near = np.zeros((rows, columns), np.bool_)
    count = 0
    for i in range(rows):
        for c in range(columns):
            square = place[1, i, c] ** 2 + place[2, i, c] ** 2
            near[i, c] = surface[i, c] == chosen and square <= reach
            count += near[i, c]
    # Some of them tell the plane as well as all.
    step = max(count // _PLENTY, 1)
    points = np.empty((3, -(-count // step)))
    count = 0
    for i in range(rows):
        for c in range(columns):
            if near[i, c]:
                if count % step == 0:
                    k = count // step
                    points[0, k], points[1, k] = place[1, i, c], place[2, i, c]
                    points[2, k] = height[i, c]
                count += 1
    x, y, h = points[0], points[1], points[2]
    total = np.zeros(9)
    p, q, r = np.median(h), 0.0, 0.0
    for _ in range(3):
        off = np.abs(h - p - q * x - r * y)
        bound = max(tolerance, np.median(off))
        total[:] = 0
        for k in range(len(h)):
            if off[k] <= bound:
                entries = (1.0, x[k], y[k], x[k] * x[k], x[k] * y[k], y[k] * y[k], h[k])
                for n in range(7):
                    total[n] += entries[n]
                total[7] += h[k] * x[k]
                total[8] += h[k] * y[k]
        p, q, r = solve_plane(total, 1e-9, 1e-9)
    for i in range(rows):
        for c in range(columns):
            if near[i, c]:
                off_plane = height[i, c] - p - q * place[1, i, c] - r * place[2, i, c]
                near[i, c] = abs(off_plane) <= tolerance
    return near
