"""Borders of regions that were found in bins, decided pixel by pixel.

Each pixel of a bin beside another region takes the label of the lowest cost given those of its
neighbours (a round of iterated conditional modes; Besag 1986).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Ints, Labels, Singles
from rangeseg_ros.core.by_planes.offsets import offset_at
from rangeseg_ros.core.by_planes.plane_energy import CAP, NO_PLANE, Models
from rangeseg_ros.core.sensing.blocks import NODE
from rangeseg_ros.core.sensing.moments import ray_of
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance

# Labels of a bin and those around it that its pixels may take: as many as meet at a corner.
_LABELS = 4


def with_sharp_borders(
    regions: Labels,
    surfaces: Ints,
    models: Models,
    image: RangeImage,
    side: int,
    sensor: SensorModel,
    prior: float,
) -> Labels:
    """Labels (H, W) of the pixels of an image of errors `sensor`; 0 where nothing was measured.

    Given are the regions (h, w) of bins, which have `side` pixels along their side, and the labels
    (h, w) of these among the planes of `models`. A border between two pixels costs `prior`.
    """
    pixels = image.inverse, image.rays, image.pinhole
    return _with_sharp_borders(regions, surfaces, models, *pixels, sensor, prior, side)


@njit(cache=True, nogil=True)
def _with_sharp_borders(
    regions: Labels,
    surfaces: Ints,
    models: Models,
    inverse: Singles,
    rays: Singles,
    pinhole: bool,
    sensor: SensorModel,
    prior: float,
    side: int,
) -> Labels:
    (rows, columns), (height, width) = regions.shape, inverse.shape
    labels, line = np.empty((height, width), np.uint16), np.empty(columns * side, np.uint16)
    for i in range(rows):
        for j in range(columns):
            for v in range(side):
                line[j * side + v] = regions[i, j]
        for u in range(i * side, min((i + 1) * side, height)):
            for v in range(width):
                labels[u, v] = line[v] * (inverse[u, v] > 0)
    names, planes = np.empty(_LABELS, np.uint16), np.empty(_LABELS, np.intp)
    nearer, near = np.empty(_LABELS), np.empty(4, np.uint16)
    for i in range(rows):
        above, below = regions[max(i - 1, 0)], regions[min(i + 1, rows - 1)]
        for j in range(columns):
            here, left, right = regions[i, j], max(j - 1, 0), min(j + 1, columns - 1)
            if here == above[j] == below[j] == regions[i, left] == regions[i, right]:
                continue
            count = 0
            for u, v in ((i, j), (i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)):
                if not (0 <= u < rows and 0 <= v < columns) or count == _LABELS:
                    continue
                c = 0
                while c < count and names[c] != regions[u, v]:
                    c += 1
                if c == count:
                    names[c], count = regions[u, v], count + 1
                    label = int(np.intp(surfaces[u, v])) if regions[u, v] > 0 else 0
                    planes[c] = label
                    nearer[c] = 1 + offset_at(models.offsets, label, i // NODE, j // NODE)
            for u in range(i * side, min((i + 1) * side, height)):
                for v in range(j * side, min((j + 1) * side, width)):
                    if inverse[u, v] == 0:
                        continue
                    others = 0
                    for a, b in ((u - 1, v), (u, v - 1), (u + 1, v), (u, v + 1)):
                        if 0 <= a < height and 0 <= b < width and inverse[a, b] > 0:
                            near[others], others = labels[a, b], others + 1
                    y, least = np.float64(inverse[u, v]), np.inf
                    ray = ray_of(rays, pinhole, u, v)
                    weight = 1 / random_variance(sensor, y * y)
                    for c in range(count):
                        name, label, cost = names[c], planes[c], NO_PLANE
                        if label > 0:
                            level = models.theta[label, 0] * ray[0]
                            level += models.theta[label, 1] * ray[1]
                            level += models.theta[label, 2] * ray[2]
                            square = weight * (y - nearer[c] * level) ** 2
                            cost = min(models.half_precision[label] * square, CAP)
                        for other in range(others):
                            cost += prior * (near[other] != name)
                        if cost < least:
                            best, least = name, cost
                    labels[u, v] = best
    return labels
