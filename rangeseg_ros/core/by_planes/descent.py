"""The labels that cuts begin with: the nearest planes, then iterated conditional modes."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.plane_energy import (
    LEAST_GAIN,
    NO_PLANE,
    Models,
    Problem,
    data_cost,
    shifted_cost,
)
from rangeseg_ros.core.by_planes.shifts import shift_at
from rangeseg_ros.core.graphcut.sites import are_alike
from rangeseg_ros.core.runtime.threads import run_halves, run_rows
from rangeseg_ros.core.sensing.grid import CHUNK

REACH = 2
"""Blocks from a surface in which its label may win pixels."""


def descended(
    problem: Problem, surfaces: NDArray[np.int32], models: Models
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """A labelling that no pixel improves by a linked neighbour's label or none, and its costs."""
    labels = np.zeros(len(problem.inverse), np.int32)
    cost = np.zeros(len(labels), np.float32)
    window = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
    exact = surfaces.astype(np.float32)
    least = cv2.erode(exact, window)
    settled = (least > 0) & (least == cv2.dilate(exact, window))
    run_rows(_take_nearest, len(surfaces), surfaces, settled, problem, models, labels, cost)
    run_halves(_descend, len(labels) // problem.width, labels, cost, problem, models)
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
    side = 2 * REACH + 1
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
            for i in range(max(bi - REACH, 0), min(bi + REACH + 1, rows)):
                for j in range(max(bj - REACH, 0), min(bj + REACH + 1, columns)):
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
        least = np.float64(cost[p]) - LEAST_GAIN
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
