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
    names = np.empty((*regions.shape, _LABELS), np.uint16)
    costs = np.empty((*regions.shape, side * side, _LABELS), np.float32)
    known = np.zeros(regions.shape, np.uint8)
    seen = regions, surfaces, models, image.inverse, image.rays, sensor
    run_rows(_fill_costs, len(regions), *seen, side, known, names, costs)
    given = known, names, costs, np.float32(prior), side, image.inverse, labels
    # Rows of bins in turn: those that change at the same time do not touch.
    for odd in (0, 1) * _ROUNDS:
        run_rows(_settle, (len(regions) + 1 - odd) // 2, odd, *given)
    return labels


@njit(cache=True, nogil=True)
def _fill_costs(
    first: int,
    after: int,
    regions: NDArray[np.uint16],
    surfaces: NDArray[np.int32],
    models: Models,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    sensor: SensorModel,
    side: int,
    known: NDArray[np.uint8],
    names: NDArray[np.uint16],
    costs: NDArray[np.float32],
) -> None:
    """What labels cost pixels (h, w, side * side, 4) of bins in some rows that are beside others.

    With the names (h, w, 4) of these labels, and how many are `known` (h, w), 0 elsewhere.
    """
    (rows, columns), (height, width) = regions.shape, inverse.shape
    planes = np.empty(_LABELS, np.intp)
    for i in range(first, after):
        for j in range(columns):
            count, own = 0, regions[i, j]
            if 0 < i < rows - 1 and 0 < j < columns - 1:
                alike = own == regions[i, j - 1] == regions[i, j + 1]
                if alike and own == regions[i - 1, j] == regions[i + 1, j]:
                    continue
            for u, v in ((i, j), (i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)):
                if not (0 <= u < rows and 0 <= v < columns) or count == _LABELS:
                    continue
                c = 0
                while c < count and names[i, j, c] != regions[u, v]:
                    c += 1
                if c == count:
                    names[i, j, c], count = regions[u, v], count + 1
                    planes[c] = surfaces[u, v] if regions[u, v] > 0 else 0
            known[i, j] = count if count > 1 else 0
            for c in range(known[i, j]):
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
                    cost = min(half_precision * square, CAP) if label > 0 else NO_PLANE
                    costs[i, j, k, c] = cost


@njit(cache=True, nogil=True)
def _settle(
    first: int,
    after: int,
    odd: int,
    known: NDArray[np.uint8],
    names: NDArray[np.uint16],
    costs: NDArray[np.float32],
    prior: np.float32,
    side: int,
    inverse: NDArray[np.float32],
    labels: NDArray[np.uint16],
) -> None:
    """Give pixels of bins in every second row the label of the lowest cost, in place."""
    height, width = labels.shape
    for i in range(2 * first + odd, 2 * after + odd - 1, 2):
        for j in range(known.shape[1]):
            for k in range(side * side if known[i, j] > 0 else 0):
                u, v = i * side + k // side, j * side + k % side
                if u >= height or v >= width or inverse[u, v] == 0:
                    continue
                least = np.float32(np.inf)
                for c in range(known[i, j]):
                    label, cost = names[i, j, c], costs[i, j, k, c]
                    for a, b in ((u - 1, v), (u, v - 1), (u + 1, v), (u, v + 1)):
                        if 0 <= a < height and 0 <= b < width and inverse[a, b] > 0:
                            cost += prior * (labels[a, b] != label)
                    if cost < least:
                        best, least = label, cost
                labels[u, v] = best
