"""Planes as labels (thesis 5.1.2): every pixel takes the plane that explains it."""

from __future__ import annotations

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Ints, Singles
from rangeseg_ros.core.by_planes.offsets import local_offsets
from rangeseg_ros.core.by_planes.plane_energy import (
    LEAST_GAIN,
    NO_PLANE,
    Models,
    Problem,
    data_cost,
)
from rangeseg_ros.core.graphcut.expansion import GridLabelling, band, beyond, expand, fronts
from rangeseg_ros.core.runtime.threads import map_halves, run_halves
from rangeseg_ros.core.sensing.blocks import NODE
from rangeseg_ros.core.sensing.sensor import SensorModel

# Pixels by which a label may expand at once: borders of blocks are off by up to a block.
_BAND = NODE
# Blocks around a surface where offsets of its plane are computed as well.
_MARGIN = 4


def refine(
    problem: Problem, surfaces: Ints, blocks: Floats, moments: Floats, sensor: SensorModel
) -> tuple[Ints, Models]:
    """Label the pixels (n,) with the planes of the surfaces (rows, columns) of blocks, or 0.

    Given are the moments of the blocks (rows, columns, 13) and of the surfaces (K + 1, 13), and
    the errors of the image.
    """
    models = Models.of(moments, sensor.distortion_pixels)
    # Offsets are means over windows as wide as the distortion, within which it hardly changes.
    around = int(sensor.distortion_length / NODE - 1) // 2
    local = local_offsets(surfaces, blocks, models.theta, _MARGIN, around, sensor.block_inflation)
    models = models._replace(offsets=local)
    labels = np.empty(len(problem.inverse), np.int32)
    # What labels cost is worked out where it is asked for.
    data = np.full(len(labels), np.nan, np.float32)
    map_halves(_label_blocks, len(surfaces), surfaces, labels, data, problem, models)
    labelling = GridLabelling.of(labels, data, problem.links, problem.width)
    run_halves(_expand_near, len(labels) // problem.width, labelling, problem, models)
    return labels, models


@njit(cache=True, nogil=True)
def _label_blocks(
    first: int,
    after: int,
    surfaces: Ints,
    labels: Ints,
    data: Singles,
    problem: Problem,
    models: Models,
) -> None:
    """Label the pixels of rows first...after of blocks with the surfaces of these.

    The pixels of a block without a surface, most of which a border crosses, get the label of the
    lowest cost among those of the blocks around it: expansions then have less to change.
    """
    width = problem.width
    around = np.empty(9, np.int32)
    for bi in range(first, after):
        for bj in range(surfaces.shape[1]):
            own = surfaces[bi, bj]
            count = 0
            if own == 0:
                for label in surfaces[max(bi - 1, 0) : bi + 2, max(bj - 1, 0) : bj + 2].flat:
                    if label > 0 and label not in around[:count]:
                        around[count] = label
                        count += 1
            for i in range(bi * NODE, min((bi + 1) * NODE, len(labels) // width)):
                for p in range(i * width + bj * NODE, i * width + min((bj + 1) * NODE, width)):
                    labels[p] = own if problem.weight[p] > 0 else 0
                    if count == 0 or problem.weight[p] == 0:
                        continue
                    data[p] = NO_PLANE
                    for label in around[:count]:
                        cost = data_cost(int(np.intp(label)), int(np.intp(p)), problem, models)
                        if cost < data[p]:
                            labels[p], data[p] = label, cost


@njit(cache=True, nogil=True)
def _expand_near(
    rows: tuple[int, int], labelling: GridLabelling, problem: Problem, models: Models
) -> None:
    """Expand every label once in some rows, near its boundaries; in place.

    Label 0 is not expanded: what no plane explains costs it little more, and it gains nothing.
    """
    count = len(models.theta)
    start, sites = fronts(labelling, count, rows)
    for alpha in range(1, count):
        front = sites[start[alpha] : start[alpha + 1]]
        _expand(alpha, front, rows, _BAND, labelling, problem, models)


@njit(cache=True, nogil=True)
def _expand(
    alpha: int,
    front: Ints,
    rows: tuple[int, int],
    reach: int,
    labelling: GridLabelling,
    problem: Problem,
    models: Models,
) -> None:
    """Expand a label from its front and, where it wins, the far side of the band; in place."""
    labels, data = labelling.labels, labelling.data
    while len(front) > 0:
        sites = band(alpha, front, reach, labelling, rows)
        new = np.empty(len(sites), np.float32)
        for s in range(len(sites)):
            p = int(np.intp(sites[s]))
            new[s] = data_cost(alpha, p, problem, models)
            if np.isnan(data[p]):
                data[p] = data_cost(int(np.intp(labels[p])), p, problem, models)
        if not expand(alpha, sites, new, labelling, LEAST_GAIN):
            break
        front = beyond(alpha, sites, labelling, rows)
