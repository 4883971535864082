"""Borders of regions that were found in bins, decided pixel by pixel.

Each pixel of a bin beside another region takes the label of the lowest cost given those of its
neighbours, several times (iterated conditional modes; Besag, On the statistical analysis of dirty
pictures, 1986). Bins have minimised the same energy by cuts, so that borders are near.
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
    bins, names, planes, start = _bins_at_borders(regions, surfaces)
    costs = np.empty((len(bins), side * side, _LABELS), np.float32)
    pixels = image.inverse, image.rays, sensor
    run_rows(_fill_costs, len(bins), bins, planes, side, *pixels, models, costs)
    given = np.float32(prior), side, image.inverse, labels
    # Rows of bins in turn: those that change at the same time do not touch.
    for odd in (0, 1) * _ROUNDS:
        rows = (len(regions) + 1 - odd) // 2
        run_rows(_settle, rows, odd, start, bins, names, costs, *given)
    return labels


@njit(cache=True, nogil=True)
def _bins_at_borders(
    regions: NDArray[np.uint16], surfaces: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.intp]]:
    """Rows and columns (N, 2) of bins beside other regions, and labels (N, 5) there.

    Of the labels first their number, then the own one. The same of their surfaces; and where each
    row begins, (h + 1,).
    """
    rows, columns = regions.shape
    bins = np.empty((regions.size, 2), np.int32)
    names, planes = np.empty((2, regions.size, 1 + _LABELS), np.int32)
    start = np.zeros(rows + 1, np.intp)
    count = 0
    for i in range(rows):
        for j in range(columns):
            own, known = regions[i, j], 1
            names[count, 1] = own
            planes[count, 1] = surfaces[i, j] if own > 0 else 0
            for u, v in ((i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)):
                if not (0 <= u < rows and 0 <= v < columns):
                    continue
                label = regions[u, v]
                if label != own and known < _LABELS and label not in names[count, 1 : 1 + known]:
                    known += 1
                    names[count, known] = label
                    planes[count, known] = surfaces[u, v] if label > 0 else 0
            names[count, 0] = planes[count, 0] = known
            if known > 1:
                bins[count] = i, j
                count += 1
        start[i + 1] = count
    return bins[:count].copy(), names[:count].copy(), planes[:count].copy(), start


@njit(cache=True, nogil=True)
def _fill_costs(
    first: int,
    after: int,
    bins: NDArray[np.int32],
    planes: NDArray[np.int32],
    side: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    sensor: SensorModel,
    models: Models,
    costs: NDArray[np.float32],
) -> None:
    """What the labels of some bins cost their pixels, (N, side * side, 4)."""
    height, width = inverse.shape
    for n in range(first, after):
        i, j = bins[n]
        for c in range(planes[n, 0]):
            label = planes[n, 1 + c]
            scale = 1 + shift_at(models.shifts, label, i // NODE, j // NODE)
            theta, half_precision = models.theta[label], models.half_precision[label]
            for k in range(side * side):
                u, v = i * side + k // side, j * side + k % side
                if u >= height or v >= width or inverse[u, v] == 0:
                    continue
                costs[n, k, c] = NO_PLANE
                if label == 0:
                    continue
                y, level = np.float64(inverse[u, v]), 0.0
                for a in range(3):
                    level += theta[a] * rays[u, v, a]
                square = (y - scale * level) ** 2 / random_variance(sensor, y * y)
                costs[n, k, c] = min(half_precision * square, CAP)


@njit(cache=True, nogil=True)
def _settle(
    first: int,
    after: int,
    odd: int,
    start: NDArray[np.intp],
    bins: NDArray[np.int32],
    names: NDArray[np.int32],
    costs: NDArray[np.float32],
    prior: np.float32,
    side: int,
    inverse: NDArray[np.float32],
    labels: NDArray[np.uint16],
) -> None:
    """Give the pixels of bins in every second row the label of the lowest cost, in place."""
    height, width = labels.shape
    for n in range(start[2 * first + odd], start[2 * after + odd - 1]):
        if bins[n, 0] % 2 != odd:
            continue
        for k in range(side * side):
            u, v = bins[n, 0] * side + k // side, bins[n, 1] * side + k % side
            if u >= height or v >= width or inverse[u, v] == 0:
                continue
            least = np.float32(np.inf)
            for c in range(names[n, 0]):
                label, cost = names[n, 1 + c], costs[n, k, c]
                for a, b in ((u - 1, v), (u, v - 1), (u + 1, v), (u, v + 1)):
                    if 0 <= a < height and 0 <= b < width and inverse[a, b] > 0:
                        cost += prior * (labels[a, b] != label)
                if cost < least:
                    best, least = label, cost
            labels[u, v] = best
