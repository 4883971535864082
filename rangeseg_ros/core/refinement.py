"""Planes as labels (thesis 5.1.2): every pixel takes the plane that explains it.

The energy is the thesis's (eq. 5.3) with other labels: the data cost of a plane is the squared
residual in variances of the sensor, capped; label 0 stands for what no plane explains and has a
fixed cost; the prior is Potts over the same neighbourhood weights. Labelling and planes are
improved in turn (PEARL; Isack and Boykov, IJCV 2012): relabelling lowers the energy for the
planes at hand, refitting lowers the residuals of the labelling at hand.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.cells import bounding_boxes
from rangeseg_ros.core.growing import DISTORTION_PIXELS
from rangeseg_ros.core.moments import COUNT, RATIO, SIZE, SLOPE, add_pixel, fit_all
from rangeseg_ros.core.moves import minimum_cut
from rangeseg_ros.core.range_image import RangeImage
from rangeseg_ros.core.sensor import FLOOR, SensorModel

# Noise agrees over patches of about this many pixels, so that many count as one measurement.
_PATCH = 3.0
_SMOOTHNESS = 1.2
_NO_PLANE = 6.0 / _PATCH
_CAP = 8.0 / _PATCH
# Systematic variances granted to the pixels of a plane.
_GRANTED = 2.0
# An improvement smaller than this is rounding.
_STEP = 1e-6
# Blocks from a surface in which its label may win pixels, pixels from a boundary to cut anew.
_REACH, _BAND = 2, 3


_ROUNDS = 10


def refine(
    problem: Problem,
    surfaces: NDArray[np.intp],
    moments: NDArray[np.float64],
    sensor: SensorModel,
    least: int = 0,
    exact: bool = False,
) -> tuple[NDArray[np.int32], Models]:
    """Label the pixels with the planes of surfaces.

    Parameters
    ----------
    problem : Problem
    surfaces : (rows, columns) int
        Surface of each block, 0...K, 0 for none.
    moments : (K + 1, 13) float64
        Of the surfaces.
    sensor : SensorModel
    least : int
        Pixels of the smallest surface whose plane is tried.
    exact : bool
        Expand labels from wherever they compete, not just near their boundaries, until no
        expansion helps, refit the planes, and repeat until the labelling stands still (at most
        ten times).

    Returns
    -------
    labels : (H, W) int32
        0 = no plane.
    models : Models
        The planes the labelling was found for.
    """
    kept = moments[:, COUNT] >= least
    kept[0] = True
    surfaces = np.where(kept, np.cumsum(kept) - 1, 0)[surfaces]
    moments = moments[kept]
    models = Models.of(moments)
    labels, cost = _descended(problem, surfaces.astype(np.int32), models)
    if not exact:
        _expand_each(labels, cost, problem, models, _BAND)
        return labels, models
    for _ in range(_ROUNDS):
        before = labels.copy()
        while _expand_each(labels, cost, problem, models, _REACH * problem.block):
            pass
        if np.array_equal(labels, before):
            break
        refitted = region_moments(problem, labels, len(moments), sensor)
        refitted[:, SLOPE] = (
            moments[:, SLOPE] * refitted[:, COUNT] / np.maximum(moments[:, COUNT], 1)
        )
        models = Models.of(refitted)
        cost = _costs(labels, problem, models)
    return labels, models


class Problem(NamedTuple):
    """What the labelling has to explain.

    Attributes
    ----------
    inverse, rays : (H, W), (H, W, 3) float32
        Range image.
    weight : (H, W) float32
        1 / random variance of the inverse range; 0 where nothing was measured.
    horizontal, vertical : (H, W-1), (H-1, W) float32
        Neighbourhood weights.
    block : int
        Rows and columns of the blocks that surfaces are grown from.
    """

    inverse: NDArray[np.float32]
    rays: NDArray[np.float32]
    weight: NDArray[np.float32]
    horizontal: NDArray[np.float32]
    vertical: NDArray[np.float32]
    block: int

    @classmethod
    def of(
        cls,
        image: RangeImage,
        sensor: SensorModel,
        horizontal: NDArray[np.float32],
        vertical: NDArray[np.float32],
        block: int,
    ) -> Problem:
        """Weigh the pixels of an image by the noise of its sensor."""
        weight = _weights(image.inverse, sensor.noise, sensor.range_noise)
        return cls(image.inverse, image.rays, weight, horizontal, vertical, block)

    def crop(self, rows: slice, columns: slice) -> Problem:
        """The problem of a part of the image."""
        return self._replace(
            inverse=self.inverse[rows, columns],
            rays=self.rays[rows, columns],
            weight=self.weight[rows, columns],
            horizontal=self.horizontal[rows, columns],
            vertical=self.vertical[rows, columns],
        )


@njit(cache=True)
def _weights(
    inverse: NDArray[np.float32], noise: float, range_noise: float
) -> NDArray[np.float32]:
    weight = np.zeros_like(inverse)
    for i in range(inverse.shape[0]):
        for j in range(inverse.shape[1]):
            y = np.float64(inverse[i, j])
            if y > 0:
                weight[i, j] = 1 / (FLOOR + noise**2 + (range_noise * y * y) ** 2)
    return weight


class Models(NamedTuple):
    """The planes that are labels.

    Attributes
    ----------
    theta : (K + 1, 3) float64
        theta . ray = inverse range; entry 0 is no plane.
    tolerance : (K + 1,) float64
        Variance to allow each plane's pixels, in random variances.
    """

    theta: NDArray[np.float64]
    tolerance: NDArray[np.float64]

    @classmethod
    def of(cls, moments: NDArray[np.float64]) -> Models:
        """Planes of moment vectors (K + 1, 13)."""
        theta, _ = fit_all(moments)
        count = np.maximum(moments[:, COUNT], 1)
        ratio = moments[:, RATIO] / (count + DISTORTION_PIXELS)
        return cls(theta, 1 + moments[:, SLOPE] / count + _GRANTED * ratio)


def _descended(
    problem: Problem, surfaces: NDArray[np.int32], models: Models
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """A labelling that no pixel improves by a linked neighbour's label or none, and its costs.

    Costs in the interior of surfaces, where no label competes, are left at 0.
    """
    labels, cost = _nearest(surfaces, problem, models)
    _descend(labels, cost, problem, models)
    return labels, cost


def energy(labels: NDArray[np.int32], problem: Problem, models: Models) -> float:
    """Value of eq. 5.3: data costs plus the weights of the edges between unlike labels."""
    cost = _costs(labels, problem, models)
    unlike = problem.horizontal[labels[:, 1:] != labels[:, :-1]].sum(dtype=np.float64)
    unlike += problem.vertical[labels[1:] != labels[:-1]].sum(dtype=np.float64)
    return float(cost.sum(dtype=np.float64) + _SMOOTHNESS * unlike)


@njit(cache=True)
def _data_cost(label: int, i: int, j: int, problem: Problem, models: Models) -> float:
    """What a label costs a measured pixel."""
    if label == 0:
        return _NO_PLANE
    plane, ray = models.theta[label], problem.rays[i, j]
    residual = problem.inverse[i, j] - (plane[0] * ray[0] + plane[1] * ray[1] + plane[2] * ray[2])
    variances = problem.weight[i, j] * residual * residual / models.tolerance[label]
    return min(0.5 / _PATCH * variances, _CAP)


@njit(cache=True)
def _costs(labels: NDArray[np.int32], problem: Problem, models: Models) -> NDArray[np.float32]:
    """What each pixel's label costs it; 0 where nothing was measured."""
    cost = np.zeros(labels.shape, np.float32)
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            if problem.weight[i, j] > 0:
                cost[i, j] = _data_cost(labels[i, j], i, j, problem, models)
    return cost


@njit(cache=True)
def _nearest(
    surfaces: NDArray[np.int32], problem: Problem, models: Models
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Give each pixel the cheapest label among those of the blocks around it."""
    rows, columns = surfaces.shape
    height, width = problem.inverse.shape
    block = problem.block
    labels = np.zeros((height, width), np.int32)
    cost = np.zeros((height, width), np.float32)
    side = 2 * _REACH + 1
    candidates = np.empty(side * side, np.int32)
    for bi in range(rows):
        for bj in range(columns):
            count, settled = 0, True
            for i in range(max(bi - _REACH, 0), min(bi + _REACH + 1, rows)):
                for j in range(max(bj - _REACH, 0), min(bj + _REACH + 1, columns)):
                    label = surfaces[i, j]
                    known = label == 0
                    settled &= label > 0
                    for k in range(count):
                        known |= candidates[k] == label
                    if not known:
                        candidates[count] = label
                        count += 1
            settled &= count == 1
            for i in range(bi * block, min((bi + 1) * block, height)):
                for j in range(bj * block, min((bj + 1) * block, width)):
                    if problem.weight[i, j] == 0:
                        continue
                    if settled:
                        labels[i, j] = candidates[0]
                        continue
                    best, least = 0, np.float32(_NO_PLANE)
                    for k in range(count):
                        value = np.float32(_data_cost(candidates[k], i, j, problem, models))
                        if value < least:
                            best, least = candidates[k], value
                    labels[i, j], cost[i, j] = best, least
    return labels, cost


@njit(cache=True)
def _descend(
    labels: NDArray[np.int32], cost: NDArray[np.float32], problem: Problem, models: Models
) -> None:
    """Iterated conditional modes (Besag 1986): pixels take a neighbour's label where it pays.

    In place, until no pixel changes. It leaves the energy in a poor local minimum, but one from
    which the cuts have only the boundaries left to move.
    """
    height, width = labels.shape
    around = np.zeros(4, np.int32)
    links = np.zeros(4, np.float32)
    queue = np.empty(height * width, np.int32)
    queued = np.zeros((height, width), np.bool_)
    first = last = 0
    for i in range(height):
        for j in range(width):
            here = labels[i, j]
            if (
                (j > 0 and labels[i, j - 1] != here)
                or (j + 1 < width and labels[i, j + 1] != here)
                or (i > 0 and labels[i - 1, j] != here)
                or (i + 1 < height and labels[i + 1, j] != here)
            ) and problem.weight[i, j] > 0:
                queue[last] = i * width + j
                queued[i, j] = True
                last += 1
    waiting = last
    last %= len(queue)
    while waiting > 0:
        i, j = queue[first] // width, queue[first] % width
        first = (first + 1) % len(queue)
        waiting -= 1
        queued[i, j] = False
        here = labels[i, j]
        around[:] = here
        links[:] = 0
        if j > 0:
            around[0], links[0] = labels[i, j - 1], problem.horizontal[i, j - 1]
        if j + 1 < width:
            around[1], links[1] = labels[i, j + 1], problem.horizontal[i, j]
        if i > 0:
            around[2], links[2] = labels[i - 1, j], problem.vertical[i - 1, j]
        if i + 1 < height:
            around[3], links[3] = labels[i + 1, j], problem.vertical[i, j]
        least = cost[i, j]
        for k in range(4):
            if around[k] != here:
                least += _SMOOTHNESS * links[k]
        least -= _STEP
        for k in range(5):
            label = around[k] if k < 4 else np.int32(0)
            if label == here or (k < 4 and links[k] == 0):
                continue
            data = np.float32(_data_cost(int(label), i, j, problem, models))
            total = data
            for m in range(4):
                if around[m] != label:
                    total += _SMOOTHNESS * links[m]
            if total < least:
                least, labels[i, j], cost[i, j] = total, label, data
        if labels[i, j] == here:
            continue
        for k in range(4):
            if links[k] > 0:
                ni, nj = i + (k == 3) - (k == 2), j + (k == 1) - (k == 0)
                if not queued[ni, nj]:
                    queued[ni, nj] = True
                    queue[last] = ni * width + nj
                    last = (last + 1) % len(queue)
                    waiting += 1


def _expand_each(
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
    problem: Problem,
    models: Models,
    reach: int,
) -> bool:
    """Expand every label once, by at most `reach` pixels; in place. Whether that helped."""
    helped = False
    boxes, _ = bounding_boxes(labels, len(models.theta))
    for alpha, (top, left, bottom, right) in enumerate(boxes[1:].tolist(), 1):
        if bottom > top:
            box = slice(top, bottom), slice(left, right)
            helped |= _expand(alpha, box, labels, cost, problem, models, reach)
    return helped


def _expand(
    alpha: int,
    box: tuple[slice, slice],
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
    problem: Problem,
    models: Models,
    reach: int,
) -> bool:
    """Give label `alpha` to the best set of pixels near its own, which `box` holds; in place.

    Whether that lowered the energy.
    """
    rows, columns = (slice(max(part.start - reach - 1, 0), part.stop + reach + 1) for part in box)
    here = labels[rows, columns]
    own = (here == alpha).astype(np.uint8)
    near = cv2.dilate(own, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > own
    near &= problem.weight[rows, columns] > 0
    sites = np.flatnonzero(near)
    if not len(sites):
        return False
    index = np.full(here.shape, -1, np.int32)
    index.ravel()[sites] = np.arange(len(sites))
    excess, new, first, second, link = _expansion(
        alpha,
        sites,
        index,
        here,
        cost[rows, columns],
        problem.crop(rows, columns),
        models,
    )
    switched = minimum_cut(excess, first, second, link)
    value = excess[switched].sum() + link[switched[first] != switched[second]].sum()
    if value >= -_STEP:
        return False
    chosen = np.unravel_index(sites[switched], here.shape)
    here[chosen] = alpha
    cost[rows, columns][chosen] = new[switched]
    return True


@njit(cache=True)
def _expansion(
    alpha: int,
    sites: NDArray[np.intp],
    index: NDArray[np.int32],
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
    problem: Problem,
    models: Models,
) -> tuple[
    NDArray[np.float64],
    NDArray[np.float32],
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.float64],
]:
    """The binary problem of an expansion, in the terms of `moves`.

    Returns what switching costs each site more than staying, the data cost of switching, the
    edges between sites and the cost of cutting each.
    """
    height, width = labels.shape
    count = len(sites)
    excess = np.empty(count)
    new = np.empty(count, np.float32)
    first = np.empty(2 * count, np.int32)
    second = np.empty(2 * count, np.int32)
    link = np.empty(2 * count)
    edges = 0
    for s in range(count):
        i, j = sites[s] // width, sites[s] % width
        new[s] = _data_cost(alpha, i, j, problem, models)
        excess[s] = np.float64(new[s]) - np.float64(cost[i, j])
        here = labels[i, j]
        for k in range(4):
            if k == 0 and j + 1 < width:
                ni, nj, u = i, j + 1, problem.horizontal[i, j]
            elif k == 1 and i + 1 < height:
                ni, nj, u = i + 1, j, problem.vertical[i, j]
            elif k == 2 and j > 0:
                ni, nj, u = i, j - 1, problem.horizontal[i, j - 1]
            elif k == 3 and i > 0:
                ni, nj, u = i - 1, j, problem.vertical[i - 1, j]
            else:
                continue
            if u == 0:
                continue
            u *= _SMOOTHNESS
            there = labels[ni, nj]
            other = index[ni, nj]
            if other >= 0:
                if here != there:
                    excess[s] -= u / 2
                if k < 2:
                    first[edges], second[edges] = s, other
                    link[edges] = u if here == there else u / 2
                    edges += 1
            elif there == alpha:
                excess[s] -= u
            elif there == here:
                excess[s] += u
    return excess, new, first[:edges], second[:edges], link[:edges]


def region_moments(
    problem: Problem, labels: NDArray[np.integer], count: int, sensor: SensorModel
) -> NDArray[np.float64]:
    """Moments (count, 13) of the pixels of each label."""
    return _sum_moments(
        labels,
        count,
        problem.inverse,
        problem.rays,
        problem.weight,
        sensor.distortion,
        sensor.range_distortion,
    )


@njit(cache=True)
def _sum_moments(
    labels: NDArray[np.integer],
    count: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    weight: NDArray[np.float32],
    distortion: float,
    range_distortion: float,
) -> NDArray[np.float64]:
    moments = np.zeros((count, SIZE))
    height, width = labels.shape
    for i in range(height):
        for j in range(width):
            label = labels[i, j]
            if label > 0:
                y, w = np.float64(inverse[i, j]), np.float64(weight[i, j])
                add_pixel(moments[label], rays[i, j], y, w)
                moments[label, RATIO] += w * (distortion**2 + (range_distortion * y * y) ** 2)
    return moments
