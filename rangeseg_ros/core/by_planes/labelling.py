"""Planes as labels (thesis 5.1.2): every pixel takes the plane that explains it.

Labelling and planes are improved in turn (PEARL; Isack and Boykov, IJCV 2012): relabelling lowers
the energy (`plane_energy`) for the planes at hand, refitting lowers the residuals of the labelling
at hand.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.plane_energy import (
    LEAST_GAIN,
    Models,
    Problem,
    costs,
    data_cost,
    energy,
    region_moments,
)
from rangeseg_ros.core.by_planes.shifts import shifts
from rangeseg_ros.core.graphcut.expansion import expand
from rangeseg_ros.core.graphcut.sites import GridLabelling, Sites, band, beyond, fronts
from rangeseg_ros.core.runtime.threads import run_halves
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.sensor import SensorModel

# Pixels from a boundary to cut anew: so far may that of blocks lie from that of pixels.
_BAND = BLOCK // 2
# Blocks from a surface that shifts of its plane are known for, and that its label is expanded to
# when exact. Its plane may well explain pixels anywhere in the image, rarely the surface's.
_DOMAIN = BLOCK


def refine(
    problem: Problem,
    surfaces: NDArray[np.int32],
    blocks: NDArray[np.float64],
    moments: NDArray[np.float64],
    sensor: SensorModel,
    exact: bool = False,
    refits: int = 0,
    cuts: float = 1.0,
) -> tuple[NDArray[np.int32], Models]:
    """Label the pixels with the planes of surfaces.

    More than seven parameters: the last three are how far to go.

    Parameters
    ----------
    problem : Problem
    surfaces : (rows, columns) int32
        Surface of each block, 0...K, 0 for none.
    blocks : (rows, columns, 13) float64
        Moments of the blocks, weighted.
    moments : (K + 1, 13) float64
        Of the surfaces.
    sensor : SensorModel
        Errors of the image that the blocks are of.
    exact : bool
        Expand every label to all pixels within four blocks of its surface until no expansion
        helps; otherwise every label once, near its boundaries.
    refits : int
        Rounds, at most, of fitting the planes to the labels and the labels to the planes again;
        fewer when a round does not lower the energy, as a fit may: it does not know of the cap.
    cuts : float
        Share of the pixels near boundaries that labels are expanded to when not exact.

    Returns
    -------
    labels : (n,) int32
        0 = no plane.
    models : Models
        The planes the labelling was found for.
    """
    smooth, block = sensor.distortion_pixels, problem.block
    models = _shifted(Models.of(moments, smooth), surfaces, blocks, sensor, block)
    labels = _of_blocks(surfaces, problem)
    cost = costs(labels, problem, models)
    domains = _domains(surfaces, problem, len(moments)) if exact else None
    _minimise(labels, cost, problem, models, domains, cuts)
    value = energy(labels, problem, models) if refits else 0.0
    for _ in range(refits):
        shape = -1, problem.width
        arrays = problem.inverse.reshape(shape), problem.rays.reshape(*shape, 3)
        weight = problem.weight.reshape(shape)
        moments = region_moments(labels.reshape(shape), len(moments), *arrays, weight, sensor)
        refitted = Models.of(moments, smooth)._replace(half_precision=models.half_precision)
        refitted = _shifted(refitted, surfaces, blocks, sensor, block)
        better = labels.copy()
        _minimise(better, costs(better, problem, refitted), problem, refitted, domains, cuts)
        last, value = value, energy(better, problem, refitted)
        if value >= last - LEAST_GAIN:
            break
        labels, models = better, refitted
    return labels, models


def _of_blocks(surfaces: NDArray[np.int32], problem: Problem) -> NDArray[np.int32]:
    """Labels (n,) of the blocks (rows, columns) for their pixels that were measured."""
    size, width = problem.block, problem.width
    pixels = surfaces.repeat(size, axis=0)[: len(problem.inverse) // width]
    pixels = pixels.repeat(size, axis=1)[:, :width]
    return pixels.ravel() * (problem.weight > 0)


def _shifted(
    models: Models,
    surfaces: NDArray[np.int32],
    blocks: NDArray[np.float64],
    sensor: SensorModel,
    block: int,
) -> Models:
    """Models with the shifts of their planes wherever they may be labels.

    Windows as wide as the distortion tell them: where it changes, larger ones tell another's.
    """
    around = int(sensor.distortion_length / block - 1) // 2
    local = shifts(surfaces, blocks, models.theta, _DOMAIN, around, sensor.agreement)
    return models._replace(shifts=local)


def _minimise(
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
    problem: Problem,
    models: Models,
    domains: Sites | None,
    cuts: float,
) -> None:
    """Expand the labels near their boundaries once, or in their domains until that helps no more;
    in place.
    """
    height = len(labels) // problem.width
    labelling = GridLabelling.of(labels, cost, problem.links, problem.width)
    if domains is None:
        run_halves(_expand_near, height, labelling, problem, models, cuts)
        return
    labelling = labelling._replace(data=costs(labels, problem, models))
    chosen = 0, len(models.theta)
    while _expand_each(chosen, (0, height), labelling, problem, models, domains, 1):
        pass


def _domains(surfaces: NDArray[np.int32], problem: Problem, count: int) -> Sites:
    """Pixels that each label may expand to: no plane all, others those near their surface."""
    measured = problem.weight.reshape(-1, problem.width) > 0
    height, width = measured.shape
    window = np.ones(2 * [2 * _DOMAIN + 1], np.uint8)
    domains = [np.flatnonzero(measured)]
    for label in range(1, count):
        blocks = cv2.dilate((surfaces == label).astype(np.uint8), window) > 0
        pixels = blocks.repeat(problem.block, axis=0).repeat(problem.block, axis=1)
        domains.append(np.flatnonzero(pixels[:height, :width] & measured))
    start = np.cumsum([0, *map(len, domains)])
    return start, np.concatenate(domains).astype(np.int32)


@njit(cache=True, nogil=True)
def _expand_near(
    rows: tuple[int, int],
    labelling: GridLabelling,
    problem: Problem,
    models: Models,
    cuts: float,
) -> None:
    """Expand every label once in some rows, near its boundaries; in place.

    In the order of the labels, until the share `cuts` of the pixels at boundaries is used up.
    Label 0 is not expanded: what no plane explains costs it little more, and it gains nothing.
    """
    count = len(models.theta)
    near = fronts(labelling.labels, labelling.links, labelling.width, count, rows)
    most, after = cuts * len(near[1]), 1
    while after < count and near[0][after + 1] <= most:
        after += 1
    _expand_each((1, after), rows, labelling, problem, models, near, _BAND)


@njit(cache=True, nogil=True)
def _expand_each(
    chosen: tuple[int, int],
    rows: tuple[int, int],
    labelling: GridLabelling,
    problem: Problem,
    models: Models,
    near: Sites,
    reach: int,
) -> bool:
    """Expand labels, from the first to before the second of the `chosen`, once.

    To the pixels `near` and `reach` - 1 beyond in `rows`; in place. Whether that helped.
    """
    start, sites = near
    helped = False
    for alpha in range(*chosen):
        front = sites[start[alpha] : start[alpha + 1]]
        helped |= _expand(alpha, front, rows, reach, labelling, problem, models)
    return helped


@njit(cache=True, nogil=True)
def _expand(
    alpha: int,
    front: NDArray[np.int32],
    rows: tuple[int, int],
    reach: int,
    labelling: GridLabelling,
    problem: Problem,
    models: Models,
) -> bool:
    """Expand one label from its front, and from what it wins at the far side of the band."""
    helped = False
    while len(front) > 0:
        sites = band(alpha, front, reach, labelling, rows)
        new = np.empty(len(sites), np.float32)
        for s in range(len(sites)):
            new[s] = data_cost(alpha, int(sites[s]), problem, models)
        if not expand(alpha, sites, new, labelling, LEAST_GAIN):
            break
        helped = True
        if reach == 1:  # the sites of a domain: no band that goes along
            break
        front = beyond(alpha, sites, labelling, rows)
    return helped
