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
    across, down = regions[:, 1:] != regions[:, :-1], regions[1:] != regions[:-1]
    beside = np.zeros(regions.shape, np.bool_)
    beside[:, 1:] |= across
    beside[:, :-1] |= across
    beside[1:] |= down
    beside[:-1] |= down
    given = beside, regions, surfaces, models, side, image.inverse, image.rays, sensor
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
    beside: NDArray[np.bool_],
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
    """Give pixels of bins `beside` others the label of the lowest cost, in every second row."""
    (rows, columns), (height, width) = regions.shape, labels.shape
    names, planes = np.empty(_LABELS, np.uint16), np.empty(_LABELS, np.intp)
    costs = np.empty((side * side, _LABELS), np.float32)
    for i in range(2 * first + odd, 2 * after + odd - 1, 2):
        for j in range(columns):
            if not beside[i, j]:
                continue
            known = 0
            for u, v in ((i, j), (i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)):
                if not (0 <= u < rows and 0 <= v < columns) or known == _LABELS:
                    continue
                c = 0
                while c < known and names[c] != regions[u, v]:
                    c += 1
                if c == known:
                    names[c], known = regions[u, v], known + 1
                    planes[c] = surfaces[u, v] if regions[u, v] > 0 else 0
            for c in range(known):
                label = planes[c]
                scale = 1 + shift_at(models.shifts, label, i // NODE, j // NODE)
                theta, half_precision = models.theta[label], models.half_precision[label]
                for k in range(side * side):
                    u, v = i * side + k // side, j * side + k % side
                    if u >= height or v >= width or inverse[u, v] == 0:
                        continue
                    y, level = np.float64(inverse[u, v]), 0.0
                    for a in range(3):
                        level += theta[a] * rays[u, v, a]
                    square = (y - scale * level) ** 2 / random_variance(sensor, y * y)
                    costs[k, c] = min(half_precision * square, CAP) if label > 0 else NO_PLANE
            for k in range(side * side):
                u, v = i * side + k // side, j * side + k % side
                if u >= height or v >= width or inverse[u, v] == 0:
                    continue
                least = np.float32(np.inf)
                for c in range(known):
                    cost = costs[k, c]
                    for a, b in ((u - 1, v), (u, v - 1), (u + 1, v), (u, v + 1)):
                        if 0 <= a < height and 0 <= b < width and inverse[a, b] > 0:
                            cost += prior * (labels[a, b] != names[c])
                    if cost < least:
                        best, least = names[c], cost
                labels[u, v] = best
