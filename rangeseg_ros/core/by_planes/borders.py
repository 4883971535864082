"""Borders of regions that were found in bins, decided pixel by pixel.

Each pixel of a bin beside another region takes the label of the lowest cost given those of its
neighbours, several times (iterated conditional modes; Besag 1986).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.blocks import NODE
from rangeseg_ros.core.by_planes.plane_energy import CAP, NO_PLANE, Models
from rangeseg_ros.core.by_planes.shifts import shift_at
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance

# Labels of a bin and those around it that its pixels may take: as many as meet at a corner.
_LABELS = 4
# By then few labels change.
_ROUNDS = 2


def with_sharp_borders(
    regions: NDArray[np.uint16],
    surfaces: NDArray[np.int32],
    models: Models,
    image: RangeImage,
    side: int,
    sensor: SensorModel,
    prior: float,
) -> NDArray[np.uint16]:
    """Labels (H, W) of the pixels of an image of errors `sensor`; 0 where nothing was measured.

    Given are the regions (h, w) of bins, which have `side` pixels along their side, and the labels
    (h, w) of these among the planes of `models`. A border between two pixels costs `prior`.
    """
    height, width = image.shape
    labels = regions.repeat(side, axis=1).repeat(side, axis=0)[:height, :width] * image.valid
    given = regions, surfaces, models, side, image.inverse, image.rays, sensor
    # Rows of bins in turn: those that change at the same time do not touch.
    for odd in (0, 1) * _ROUNDS:
        rows = (len(regions) + 1 - odd) // 2
        run_rows(_settle, rows, odd, *given, np.float32(prior), labels)
    return labels


@njit(cache=True, nogil=True)
def _settle(
    first: int,
    after: int,
    odd: int,
    regions: NDArray[np.uint16],
    surfaces: NDArray[np.int32],
    models: Models,
    side: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    sensor: SensorModel,
    prior: np.float32,
    labels: NDArray[np.uint16],
) -> None:
    """Give the pixels of bins in every second row the label of the lowest cost, in place."""
    (rows, columns), (height, width) = regions.shape, labels.shape
    names, costs = np.empty(_LABELS, np.uint16), np.empty((_LABELS, side * side), np.float32)
    for i in range(2 * first + odd, 2 * after + odd - 1, 2):
        for j in range(columns):
            known, own = 0, regions[i, j]
            for u, v in ((i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)):
                inside = 0 <= u < rows and 0 <= v < columns
                if not inside or regions[u, v] == own or known == _LABELS:
                    continue
                if known == 0:
                    names[0], known = own, 1
                    label = surfaces[i, j] if own > 0 else 0
                    _fill_costs(0, label, i, j, models, side, inverse, rays, sensor, costs)
                if regions[u, v] not in names[:known]:
                    names[known] = regions[u, v]
                    label = surfaces[u, v] if names[known] > 0 else 0
                    _fill_costs(known, label, i, j, models, side, inverse, rays, sensor, costs)
                    known += 1
            for k in range(side * side if known > 0 else 0):
                u, v = i * side + k // side, j * side + k % side
                if u >= height or v >= width or inverse[u, v] == 0:
                    continue
                least = np.float32(np.inf)
                for c in range(known):
                    cost = costs[c, k]
                    for a, b in ((u - 1, v), (u, v - 1), (u + 1, v), (u, v + 1)):
                        if 0 <= a < height and 0 <= b < width and inverse[a, b] > 0:
                            cost += prior * (labels[a, b] != names[c])
                    if cost < least:
                        labels[u, v], least = names[c], cost


@njit(cache=True, nogil=True)
def _fill_costs(
    c: int,
    label: int,
    i: int,
    j: int,
    models: Models,
    side: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    sensor: SensorModel,
    costs: NDArray[np.float32],
) -> None:
    """What a label costs the measured pixels of a bin, as `costs` (4, side * side) of row c."""
    scale = 1 + shift_at(models.shifts, label, i // NODE, j // NODE)
    theta, half_precision = models.theta, models.half_precision[label]
    for k in range(side * side):
        u, v = i * side + k // side, j * side + k % side
        if u >= inverse.shape[0] or v >= inverse.shape[1] or inverse[u, v] == 0:
            continue
        y, level = np.float64(inverse[u, v]), 0.0
        for a in range(3):
            level += theta[label, a] * rays[u, v, a]
        square = (y - scale * level) ** 2 / random_variance(sensor, y * y)
        costs[c, k] = min(half_precision * square, CAP) if label > 0 else NO_PLANE
