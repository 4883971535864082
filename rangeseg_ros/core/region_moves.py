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
        own = best = labels[p]
        least = UNIT * np.float32(costs[p, own])
        for f in range(start[p], start[p + 1]):
            if labels[neighbours[f]] != own:
                least += links[f]
        for e in range(start[p], start[p + 1]):
            label = labels[neighbours[e]]
            if label == own:
                continue
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
    n, count = costs.shape
    region, order, first = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n + 1, np.int32)
    regions = _regions(labels, graph, region, order, first)
    total = np.zeros((regions, count), np.int32)
    for p in range(n):
        _add(costs[p], total[region[p]])
    # The sums of each region, the label that is cheapest by itself, and whether to look again.
    row, cheapest = np.arange(regions), np.empty(regions, np.int32)
    for r in range(regions):
        cheapest[r] = _cheapest(total[r])
    dirty = np.ones(regions, np.bool_)
    beside = np.zeros(count, np.float32)
    while regions:
        changed = False
        for r in range(regions):
            if not dirty[r]:
                continue
            dirty[r] = False
            sites = order[first[r] : first[r + 1]]
            best = _best(r, sites, region, total[row[r]], cheapest[row[r]], labels, graph, beside)
            if best != labels[sites[0]]:
                changed = True
                for p in sites:
                    labels[p] = best
                    for e in range(graph.start[p], graph.start[p + 1]):
                        there = region[graph.neighbours[e]]
                        dirty[there] |= there != r
        if not changed:
            break
        members = order[first[:regions]].copy()
        regions = _regions(labels, graph, region, order, first)
        row_before, dirty_before = row, dirty
        row, dirty = np.full(regions, -1), np.zeros(regions, np.bool_)
        for before in range(len(members)):
            r = region[members[before]]
            if row[r] < 0:
                row[r], dirty[r] = row_before[before], dirty_before[before]
            else:
                _add(total[row_before[before]], total[row[r]])
                cheapest[row[r]] = _cheapest(total[row[r]])
                dirty[r] = True


@njit(cache=True)
def _add(costs: NDArray[np.integer], total: NDArray[np.int32]) -> None:
    for k in range(len(costs)):
        total[k] += costs[k]


@njit(cache=True)
def _cheapest(costs: NDArray[np.int32]) -> int:
    least = costs[0]
    for k in range(len(costs)):
        least = min(least, costs[k])
    k = 0
    while costs[k] > least:
        k += 1
    return k


@njit(cache=True)
def _best(
    r: int,
    sites: NDArray[np.int32],
    region: NDArray[np.int32],
    costs: NDArray[np.int32],
    cheapest: int,
    labels: NDArray[np.int32],
    graph: Graph,
    beside: NDArray[np.float32],
) -> int:
    """Label that costs a region least: its own, its neighbours' or the cheapest of all.

    `beside` is 0.
    """
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    own = labels[sites[0]]
    for p in sites:
        for e in range(start[p], start[p + 1]):
            if region[neighbours[e]] != r:
                beside[labels[neighbours[e]]] += links[e]
    best, least = own, UNIT * np.float32(costs[own]) - beside[own] - np.float32(ROUNDING)
    value = UNIT * np.float32(costs[cheapest]) - beside[cheapest]
    if value < least:
        best, least = cheapest, value
    for p in sites:
        for e in range(start[p], start[p + 1]):
            k = labels[neighbours[e]]
            if beside[k] > 0:
                value = UNIT * np.float32(costs[k]) - beside[k]
                if value < least:
                    best, least = k, value
                beside[k] = 0
    return best
