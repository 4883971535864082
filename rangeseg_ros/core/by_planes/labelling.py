"""Planes as labels (thesis 5.1.2): every pixel takes the plane that explains it.

Labelling and planes are improved in turn (PEARL; Isack and Boykov, IJCV 2012): relabelling lowers
the energy (`plane_energy`) for the planes at hand, refitting lowers the residuals of the labelling
at hand.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.plane_energy import (
    NO_PLANE,
    Models,
    Problem,
    costs,
    data_cost,
    energy,
    region_moments,
    shifted_cost,
)
from rangeseg_ros.core.by_planes.shifts import shift_at, shifts
from rangeseg_ros.core.graphcut.expansion import (
    GridLabelling,
    Sites,
    are_alike,
    band,
    beyond,
    expand,
    fronts,
)
from rangeseg_ros.core.runtime.threads import run_rows, submit
from rangeseg_ros.core.sensing.grid import CHUNK
from rangeseg_ros.core.sensing.sensor import SensorModel

# An improvement smaller than this is rounding.
_STEP = 1e-6
# Blocks from a surface in which its label may win pixels, pixels from a boundary to cut anew.
_REACH, _BAND = 2, 2
# Blocks from a surface that its label is expanded to when exact. Its plane may well explain pixels
# anywhere in the image, but these are rarely the surface's.
_DOMAIN = 4
# Rows on either side of the middle of the image that are looked at again.
_SEAM = 8


def refine(
    problem: Problem,
    surfaces: NDArray[np.intp],
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
    surfaces : (rows, columns) int
        Surface of each block, 0...K, 0 for none.
    blocks : (rows, columns, 13) float64
        Moments of the blocks, weighted.
    moments : (K + 1, 13) float64
        Of the surfaces.
    sensor : SensorModel
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
    starts = surfaces.astype(np.int32)
    models = _shifted(Models.of(moments, problem.enlarged), starts, blocks, sensor)
    labels, cost = _descended(problem, starts, models)
    domains = _domains(starts, problem, len(moments)) if exact else None
    _minimise(labels, cost, problem, models, domains, cuts)
    value = energy(labels, problem, models) if refits else 0.0
    for _ in range(refits):
        shape = -1, problem.width
        arrays = problem.inverse.reshape(shape), problem.rays.reshape(*shape, 3)
        weight = problem.weight.reshape(shape)
        moments = region_moments(labels.reshape(shape), len(moments), *arrays, weight, sensor)
        refitted = Models.of(moments, problem.enlarged)._replace(price=models.price)
        refitted, better = _shifted(refitted, starts, blocks, sensor), labels.copy()
        _minimise(better, costs(better, problem, refitted), problem, refitted, domains, cuts)
        last, value = value, energy(better, problem, refitted)
        if value >= last - _STEP:
            break
        labels, models = better, refitted
    return labels, models


def _shifted(
    models: Models, surfaces: NDArray[np.int32], blocks: NDArray[np.float64], sensor: SensorModel
) -> Models:
    """Models with the shifts of their planes wherever they may be labels."""
    local = shifts(surfaces, blocks, models.theta, _DOMAIN, sensor.agreement)
    return models._replace(shifts=local)


def _minimise(
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
    problem: Problem,
    models: Models,
    domains: Sites | None,
    cuts: float,
) -> None:
    """Expand the labels near their boundaries, or in their domains until none helps; in place."""
    if domains is None:
        labelling = GridLabelling.of(labels, cost, problem.links, problem.width)
        _in_halves(_expand_near, len(labels) // problem.width, labelling, problem, models, cuts)
        return
    cost = costs(labels, problem, models)
    labelling = GridLabelling.of(labels, cost, problem.links, problem.width)
    everywhere = 0, len(labels) // problem.width
    while _expand_each((0, len(models.theta)), everywhere, labelling, problem, models, domains, 1):
        pass


def _in_halves(kernel: Callable[..., None], height: int, *arguments: Any) -> None:
    """Run kernel(rows, *arguments) on both halves of an image at once, then where they meet.

    Two rows in the middle are left to the end, so that neither half sees the other change: the
    result is the same for any number of threads.
    """
    middle = height // 2
    lower = submit(kernel, (min(middle + 1, height), height), *arguments)
    kernel((0, max(middle - 1, 0)), *arguments)
    lower.result()
    kernel((max(middle - _SEAM, 0), min(middle + _SEAM, height)), *arguments)


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


def _descended(
    problem: Problem, surfaces: NDArray[np.int32], models: Models
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """A labelling that no pixel improves by a linked neighbour's label or none, and its costs."""
    labels = np.zeros(len(problem.inverse), np.int32)
    cost = np.zeros(len(labels), np.float32)
    window = np.ones((2 * _REACH + 1, 2 * _REACH + 1), np.uint8)
    exact = surfaces.astype(np.float32)
    least = cv2.erode(exact, window)
    settled = (least > 0) & (least == cv2.dilate(exact, window))
    run_rows(_take_nearest, len(surfaces), surfaces, settled, problem, models, labels, cost)
    _in_halves(_descend, len(labels) // problem.width, labels, cost, problem, models)
    return labels, cost


@njit(cache=True, nogil=True)
def _take_nearest(
    first: int,
    after: int,
    surfaces: NDArray[np.int32],
    settled: NDArray[np.bool_],
    problem: Problem,
    models: Models,
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
) -> None:
    """Give each pixel of rows of blocks the cheapest label among those of the blocks around it.

    Costs in `settled` blocks, where no label competes, stay 0.
    """
    rows, columns = surfaces.shape
    width, block = problem.width, problem.block
    height = len(labels) // width
    side = 2 * _REACH + 1
    candidates, scale = np.empty(side * side, np.int32), np.empty(side * side)
    for bi in range(first, after):
        top, bottom = bi * block, min((bi + 1) * block, height)
        for bj in range(columns):
            left, right = bj * block, min((bj + 1) * block, width)
            if settled[bi, bj]:
                for i in range(top, bottom):
                    for p in range(i * width + left, i * width + right):
                        labels[p] = surfaces[bi, bj] if problem.weight[p] > 0 else 0
                continue
            count, last = 0, np.int32(0)
            for i in range(max(bi - _REACH, 0), min(bi + _REACH + 1, rows)):
                for j in range(max(bj - _REACH, 0), min(bj + _REACH + 1, columns)):
                    label = surfaces[i, j]
                    if label in (np.int32(0), last):
                        continue
                    last, known = label, False
                    for k in range(count):
                        known |= candidates[k] == label
                    if not known:
                        candidates[count] = label
                        scale[count] = 1 + shift_at(models.shifts, label, bi, bj)
                        count += 1
            for i in range(top, bottom):
                for p in range(i * width + left, i * width + right):
                    if problem.weight[p] == 0:
                        continue
                    best, least = np.int32(0), np.float32(NO_PLANE)
                    for k in range(count):
                        label = candidates[k]
                        value = np.float32(shifted_cost(label, p, scale[k], problem, models))
                        if value < least:
                            best, least = label, value
                    labels[p], cost[p] = best, least


@njit(cache=True, nogil=True)
def _descend(
    rows: tuple[int, int],
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
    problem: Problem,
    models: Models,
) -> None:
    """Iterated conditional modes (Besag 1986): pixels take a neighbour's label where it pays.

    In place, until no pixel of the rows from the first to before the second changes. It leaves the
    energy in a poor local minimum, but one from which the cuts have only the boundaries left to
    move.
    """
    begin, end = rows[0] * problem.width, rows[1] * problem.width
    offsets = np.array([1, problem.width, -1, -problem.width])
    links = problem.links
    around = np.zeros(4, np.int32)
    link = np.zeros(4)
    # A ring, long enough as no pixel is in it twice.
    queue = np.empty(max(end - begin, 1), np.int32)
    queued = np.zeros(end - begin, np.bool_)
    waiting = 0
    for chunk in range(max(begin - problem.width, 0), end, CHUNK):
        stop = min(chunk + CHUNK, end)
        if are_alike(labels, chunk, stop, problem.width):
            continue
        for p in range(chunk, stop):
            for k in range(2):
                q = p + offsets[k]
                if q < len(labels) and labels[q] != labels[p] and links[k, p] > 0:
                    for site in (p, q):
                        if begin <= site < end and not queued[site - begin]:
                            queue[waiting] = site
                            queued[site - begin] = True
                            waiting += 1
    first, last = 0, waiting % len(queue)
    while waiting > 0:
        p = queue[first]
        first = (first + 1) % len(queue)
        waiting -= 1
        queued[p - begin] = False
        here = labels[p]
        least = np.float64(cost[p]) - _STEP
        for k in range(4):
            q = p + offsets[k]
            link[k] = links[k % 2, min(p, q)]
            around[k] = labels[q] if link[k] > 0 else here
            if around[k] != here:
                least += link[k]
        for k in range(5):
            label = around[k] if k < 4 else np.int32(0)
            if label == here:
                continue
            data = np.float32(data_cost(int(label), int(p), problem, models))
            total = np.float64(data)
            for m in range(4):
                if around[m] != label:
                    total += link[m]
            if total < least:
                least, labels[p], cost[p] = total, label, data
        if labels[p] == here:
            continue
        for k in range(4):
            q = p + offsets[k]
            if link[k] > 0 and begin <= q < end and not queued[q - begin]:
                queued[q - begin] = True
                queue[last] = q
                last = (last + 1) % len(queue)
                waiting += 1


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
    Label 0 is not expanded: every pixel has had that choice, and it gains next to nothing.
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
        if not expand(alpha, sites, new, labelling, _STEP):
            break
        helped = True
        if reach == 1:  # the sites of a domain: no band that goes along
            break
        front = beyond(alpha, sites, labelling, rows)
    return helped
