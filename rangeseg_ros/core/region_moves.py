"""Moves of pieces and of regions: each takes the label that costs it least.

A region is a connected set of pieces of one label. Regions that took the same label grow together
and then turn as one.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.moves import ROUNDING
from rangeseg_ros.core.piece_graph import Graph
from rangeseg_ros.core.pieces import UNIT


@njit(cache=True)
def settle(labels: NDArray[np.int32], costs: NDArray[np.uint16], graph: Graph) -> None:
    """Give every piece in turn the label, its own or a neighbour's, that costs least.

    Parameters
    ----------
    labels : (n,) int32
        In place.
    costs : (n, K) uint16
        Of each label at each piece, in `UNIT`.
    graph : Graph
    """
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    for p in range(len(labels)):
        best, least = labels[p], np.float32(np.inf)
        for e in range(start[p] - 1, start[p + 1]):
            label = labels[p] if e < start[p] else labels[neighbours[e]]
            value = UNIT * np.float32(costs[p, label])
            for f in range(start[p], start[p + 1]):
                if labels[neighbours[f]] != label:
                    value += links[f]
            if value < least:
                best, least = label, value
        labels[p] = best


@njit(cache=True)
def _regions(
    labels: NDArray[np.int32],
    graph: Graph,
    region: NDArray[np.int32],
    order: NDArray[np.int32],
    first: NDArray[np.int32],
) -> int:
    """Connected pieces of a label: region r is order[first[r] : first[r + 1]]; how many."""
    start, neighbours = graph.start, graph.neighbours
    region[:] = -1
    count = last = 0
    for seed in range(len(labels)):
        if region[seed] >= 0:
            continue
        first[count] = done = last
        region[seed] = count
        order[last] = seed
        last += 1
        while done < last:
            p = order[done]
            done += 1
            for e in range(start[p], start[p + 1]):
                q = neighbours[e]
                if region[q] < 0 and labels[q] == labels[p]:
                    region[q] = count
                    order[last] = q
                    last += 1
        count += 1
    first[count] = last
    return count


@njit(cache=True)
def turn(labels: NDArray[np.int32], costs: NDArray[np.uint16], graph: Graph) -> None:
    """Give every region in turn the label that costs least, until that changes nothing.

    Parameters
    ----------
    labels : (n,) int32
        In place.
    costs : (n, K) uint16
        Of each label at each piece, in `UNIT`.
    graph : Graph
    """
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    n, count = costs.shape
    region, order, first = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n + 1, np.int32)
    regions = _regions(labels, graph, region, order, first)
    total = np.zeros((regions, count), np.float32)
    for p in range(n):
        row, sums = costs[p], total[region[p]]
        for k in range(count):
            sums[k] += UNIT * np.float32(row[k])
    beside = np.zeros(count, np.float32)
    while regions:
        changed = False
        for r in range(regions):
            sites, row = order[first[r] : first[r + 1]], total[r]
            for p in sites:
                for e in range(start[p], start[p + 1]):
                    if region[neighbours[e]] != r:
                        beside[labels[neighbours[e]]] += links[e]
            before = best = labels[sites[0]]
            least = row[best] - beside[best] - np.float32(ROUNDING)
            for k in range(count):
                if row[k] - beside[k] < least:
                    best, least = k, row[k] - beside[k]
            for p in sites:
                for e in range(start[p], start[p + 1]):
                    beside[labels[neighbours[e]]] = 0
            if best != before:
                changed = True
                for p in sites:
                    labels[p] = best
        if not changed:
            return
        members = order[first[:regions]].copy()
        regions = _regions(labels, graph, region, order, first)
        merged = np.zeros((regions, count), np.float32)
        for r in range(len(members)):
            row, sums = total[r], merged[region[members[r]]]
            for k in range(count):
                sums[k] += row[k]
        total = merged
