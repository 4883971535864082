"""The labels that expansions begin with: of the surfaces near a pixel the one that fits best."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.plane_energy import (
    CAP,
    NO_PLANE,
    Models,
    Problem,
    plane_cost,
    shifted_plane,
)
from rangeseg_ros.core.by_planes.shifts import shift_at
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.ray_rows import first_rays, next_rays

REACH = 2
"""Blocks from a surface in which its label may win pixels."""
# Above all labels.
_NONE = np.int32(np.iinfo(np.int32).max)


def nearest(
    problem: Problem, surfaces: NDArray[np.int32], models: Models
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The cheapest label of each pixel (n,) among those of the blocks around it, and its cost.

    Costs in blocks with one label around them, for which none competes, are 0.
    """
    labels = np.empty(len(problem.inverse), np.int32)
    cost = np.empty(len(labels), np.float32)
    run_rows(_take_nearest, len(surfaces), surfaces, problem, models, labels, cost)
    return labels, cost


@njit(cache=True, nogil=True)
def _take_nearest(
    first: int,
    after: int,
    surfaces: NDArray[np.int32],
    problem: Problem,
    models: Models,
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
) -> None:
    """What `nearest` returns, of some rows of blocks."""
    columns, most = surfaces.shape[1], (2 * REACH + 1) ** 2
    width, block = problem.width, problem.block
    height = len(labels) // width
    # Of each block in a row of blocks: its candidates with their shifts, and how many they are.
    candidates, shifts = np.empty((columns, most), np.int32), np.empty((columns, most))
    count = np.empty(columns, np.intp)
    # The first of them, for each column of pixels.
    label, planes = np.empty(width, np.int32), np.zeros((5, width))
    rays = problem.rays.reshape(height, width, 3)
    ray = first_rays(rays, 0)
    above, around = np.empty((3, columns + 2 * REACH), np.int32), np.empty((3, columns), np.int32)
    for bi in range(first, after):
        top, bottom = bi * block, min((bi + 1) * block, height)
        _find_ranges(bi, surfaces, above, around)
        for bj in range(columns):
            lowest, least, highest = around[0, bj], around[1, bj], around[2, bj]
            candidates[bj, 0] = highest
            count[bj] = highest > 0
            left, right = bj * block, min((bj + 1) * block, width)
            if lowest == highest:
                # What is infinitely precise explains nothing; what is not precise explains all.
                for j in range(left, right):
                    label[j], planes[4, j] = highest, np.inf if highest == 0 else 0.0
                continue
            if least < highest:
                own = candidates[bj], shifts[bj]
                count[bj] = _find_candidates(bi, bj, surfaces, above, models, *own)
            else:
                shifts[bj, 0] = shift_at(models.shifts, highest, bi, bj)
            plane = shifted_plane(candidates[bj, 0], shifts[bj, 0], models)
            for j in range(left, right):
                label[j] = candidates[bj, 0]
                for entry in range(5):
                    planes[entry, j] = plane[entry]
        for i in range(top, bottom):
            here = slice(i * width, (i + 1) * width)
            next_rays(rays, problem.pinhole, i, ray)
            row = problem.inverse[here], ray, problem.weight[here]
            _take_first(label, planes, *row, labels[here], cost[here])
        for bj in range(columns):
            for k in range(1, count[bj]):
                plane = shifted_plane(candidates[bj, k], shifts[bj, k], models)
                for i in range(top, bottom):
                    for j in range(bj * block, min((bj + 1) * block, width)):
                        p = i * width + j
                        value = np.float32(plane_cost(plane, i * width, j, problem))
                        better = value < cost[p]
                        labels[p] = candidates[bj, k] if better else labels[p]
                        cost[p] = value if better else cost[p]


@njit(cache=True, nogil=True)
def _find_ranges(
    row: int,
    surfaces: NDArray[np.int32],
    above: NDArray[np.int32],
    around: NDArray[np.int32],
) -> None:
    """Labels of the blocks around each one of a row: the lowest, the lowest but 0, the highest.

    To `around` (3, columns); the second is `_NONE` where there is no label but 0. Those `above`
    and below it, (3, columns + 2 REACH), are told as well.
    """
    rows, columns = surfaces.shape
    above[:2], above[2] = _NONE, 0
    around[:2], around[2] = _NONE, 0
    # Down the columns, then along the row: views, of which the compiler takes many at a time.
    lowest, least, highest = above[0, REACH:-REACH], above[1, REACH:-REACH], above[2, REACH:-REACH]
    for i in range(max(row - REACH, 0), min(row + REACH + 1, rows)):
        own = surfaces[i]
        for j in range(columns):
            label = own[j]
            lowest[j] = min(lowest[j], label)
            least[j] = min(least[j], label if label > 0 else _NONE)
            highest[j] = max(highest[j], label)
    for step in range(2 * REACH + 1):
        lowest, least = above[0, step : step + columns], above[1, step : step + columns]
        highest = above[2, step : step + columns]
        for j in range(columns):
            around[0, j] = min(around[0, j], lowest[j])
            around[1, j] = min(around[1, j], least[j])
            around[2, j] = max(around[2, j], highest[j])


@njit(cache=True, nogil=True)
def _find_candidates(
    row: int,
    column: int,
    surfaces: NDArray[np.int32],
    above: NDArray[np.int32],
    models: Models,
    candidates: NDArray[np.int32],
    shifts: NDArray[np.float64],
) -> int:
    """Labels of the blocks around one and the shifts of their planes there; how many.

    `above` is that of `_find_ranges` for this row.
    """
    rows, columns = surfaces.shape
    count, last = 0, np.int32(0)
    top, bottom = max(row - REACH, 0), min(row + REACH + 1, rows)
    for j in range(max(column - REACH, 0), min(column + REACH + 1, columns)):
        alike = above[0, j + REACH] == above[2, j + REACH]
        for i in range(top, top + 1 if alike else bottom):
            label = surfaces[i, j]
            if label in (np.int32(0), last):
                continue
            last, known = label, False
            for k in range(count):
                known |= candidates[k] == label
            if not known:
                candidates[count] = label
                shifts[count] = shift_at(models.shifts, label, row, column)
                count += 1
    return count


@njit(cache=True, nogil=True)
def _take_first(
    label: NDArray[np.int32],
    planes: NDArray[np.float64],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    weight: NDArray[np.float32],
    labels: NDArray[np.int32],
    cost: NDArray[np.float32],
) -> None:
    """Give each pixel of a row its first candidate, or none where that costs more."""
    a, b, c, scale, half_precision = planes[0], planes[1], planes[2], planes[3], planes[4]
    x, y, z = rays[0], rays[1], rays[2]
    # Without branches, so that the compiler takes many pixels at a time.
    for j in range(len(labels)):
        level = a[j] * x[j] + b[j] * y[j] + c[j] * z[j]
        residual = inverse[j] - scale[j] * level
        value = np.float32(min(half_precision[j] * weight[j] * residual * residual, CAP))
        measured, better = weight[j] > 0, value < np.float32(NO_PLANE)
        labels[j] = label[j] if measured & better else np.int32(0)
        cost[j] = (value if better else np.float32(NO_PLANE)) if measured else np.float32(0)
