"""What every second, or fourth, column and row tells, for all pixels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.grid import GridEdges
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import chi2_quantile

# Square of a residual, in variances, that is no chance: no plane explains that pixel.
_NO_PLANE = chi2_quantile(1)


def labels_of_all(
    labels: NDArray[np.uint16],
    step: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    theta: NDArray[np.float64],
    sensor: SensorModel,
) -> tuple[NDArray[np.uint16], NDArray[np.int64]]:
    """Labels of all measured pixels from those of every `step`-th column and row.

    A pixel between them takes that label, of the two or four around it, whose plane it fits best.

    Parameters
    ----------
    labels : (ceil(H / step), ceil(W / step)) uint16
        0...M; 0 = no plane.
    step : int
    inverse : (H, W) float32
        Of all pixels; 0 where nothing was measured.
    rays : (H, W, 3) float32
    theta : (M + 1, 3) float64
        The planes: theta . ray = inverse.
    sensor : SensorModel

    Returns
    -------
    labels : (H, W) uint16
    counts : (M + 1,) int64
        Measured pixels of each label.
    """
    found = np.zeros(inverse.shape, np.uint16)
    pixels = inverse, rays, theta, sensor
    upper, lower = map_halves(_choose, len(inverse), labels, step, *pixels, found)
    return found, upper + lower


@njit(cache=True, nogil=True)
def _choose(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    step: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    theta: NDArray[np.float64],
    sensor: SensorModel,
    found: NDArray[np.uint16],
) -> NDArray[np.int64]:
    rows, columns = labels.shape
    width = inverse.shape[1]
    counts = np.zeros(len(theta), np.int64)
    for row in range(first, after):
        above = row // step
        below = above if row == above * step else min(above + 1, rows - 1)
        for left in range(columns):
            right = min(left + 1, columns - 1)
            nearest, lower = labels[above, left], labels[below, left]
            others = lower, labels[above, right], labels[below, right]
            alike = nearest == others[0] == others[1] == others[2]
            for column in range(left * step, min((left + 1) * step, width)):
                measured = inverse[row, column]
                if measured == 0:
                    continue
                label = nearest
                if not alike:
                    ray = rays[row, column, 0], rays[row, column, 1], rays[row, column, 2]
                    square = measured * measured
                    variance = random_variance(sensor, square)
                    variance += systematic_variance(sensor, square)
                    least = _cost(label, measured, ray, theta, variance)
                    for other in others if column > left * step else (lower, lower, lower):
                        if other != label:
                            cost = _cost(other, measured, ray, theta, variance)
                            if cost < least:
                                label, least = other, cost
                found[row, column] = label
                counts[label] += 1
    return counts


@njit(cache=True, nogil=True, inline='always')
def _cost(
    label: int,
    measured: float,
    ray: tuple[float, float, float],
    theta: NDArray[np.float64],
    variance: float,
) -> float:
    """Square of the residual in variances; of no plane, what is no chance."""
    if label == 0:
        return _NO_PLANE
    x, y, z = ray
    residual = measured - (theta[label, 0] * x + theta[label, 1] * y + theta[label, 2] * z)
    return residual * residual / variance


def edges_of_all(edges: GridEdges, step: int, valid: NDArray[np.bool_]) -> GridEdges:
    """Jump edges between all measured pixels (H, W), beside the pixels that were looked at."""
    height, width = valid.shape
    across = np.zeros((height, width - 1), np.bool_)
    across[:, step - 1 :: step] = edges[0].repeat(step, axis=0)[:height]
    down = np.zeros((height - 1, width), np.bool_)
    down[step - 1 :: step] = edges[1].repeat(step, axis=1)[:, :width]
    return across & valid[:, 1:] & valid[:, :-1], down & valid[1:] & valid[:-1]
