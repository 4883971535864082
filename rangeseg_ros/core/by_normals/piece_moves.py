"""Moves of regions of pieces: each takes the label that costs it least.

A region is a connected set of pieces of one label. Regions that took the same label join and then
move as one: iterated conditional modes (Besag, JRSS B 1986) whose sites grow.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.angles import UNIT
from rangeseg_ros.core.by_normals.piece_graph import Graph
from rangeseg_ros.core.graphcut.cut import ROUNDING
from rangeseg_ros.core.runtime.threads import run_rows


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


def relabel_regions(labels: NDArray[np.int32], costs: NDArray[np.uint16], graph: Graph) -> None:
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
    total = np.empty((regions, count), np.int32)
    run_rows(_sum_up, count, costs, region, total)
    _relabel(labels, region, order, first, total, graph)


@njit(cache=True, nogil=True)
def _sum_up(
    begin: int,
    after: int,
    costs: NDArray[np.uint16],
    region: NDArray[np.int32],
    total: NDArray[np.int32],
) -> None:
    """Costs of some labels, summed over each region."""
    total[:, begin:after] = 0
    for p in range(len(costs)):
        row, sums = costs[p, begin:after], total[region[p], begin:after]
        for k in range(len(row)):
            sums[k] += row[k]


@njit(cache=True)
def _relabel(
    labels: NDArray[np.int32],
    region: NDArray[np.int32],
    order: NDArray[np.int32],
    first: NDArray[np.int32],
    total: NDArray[np.int32],
    graph: Graph,
) -> None:
    """Turn the regions of `_regions`, whose costs are `total`; all in place."""
    start, neighbours = graph.start, graph.neighbours
    regions, count = total.shape
    # The sums of each region, the label that is cheapest by itself, and whether to look again.
    row, cheapest = np.arange(regions), np.empty(regions, np.int32)
    for r in range(regions):
        cheapest[r] = _cheapest(total[r])
    dirty = np.ones(regions, np.bool_)
    beside = np.zeros(count, np.float32)
    turned = np.empty(regions, np.int32)
    while True:
        turns = 0
        for r in range(regions):
            if not dirty[r]:
                continue
            dirty[r] = False
            sites = order[first[r] : first[r + 1]]
            best = _best(r, sites, region, total[row[r]], cheapest[row[r]], labels, graph, beside)
            if best != labels[sites[0]]:
                turned[turns] = r
                turns += 1
                for p in sites:
                    labels[p] = best
                    for e in range(start[p], start[p + 1]):
                        there = region[neighbours[e]]
                        dirty[there] |= there != r
        if turns == 0:
            return
        number = _joined(turned[:turns], labels, region, order, first, graph)
        before, regions = regions, 0
        for r in range(before):
            now = number[r]
            if now == regions:
                regions += 1
                row[now], dirty[now] = row[r], dirty[r]
            else:
                source, target = total[row[r]], total[row[now]]
                for k in range(count):
                    target[k] += source[k]
                cheapest[row[now]] = _cheapest(total[row[now]])
                dirty[now] = True


@njit(cache=True)
def _joined(
    turned: NDArray[np.int32],
    labels: NDArray[np.int32],
    region: NDArray[np.int32],
    order: NDArray[np.int32],
    first: NDArray[np.int32],
    graph: Graph,
) -> NDArray[np.int32]:
    """Join regions that turned to those of the same label beside them: new number of each.

    Keeps their order, and `region`, `order` and `first` as `_regions` would have them.
    """
    regions = region.max() + 1
    # The first of the regions that each one is joined to, a root of trees.
    parent = np.arange(regions)
    for r in turned:
        for p in order[first[r] : first[r + 1]]:
            for e in range(graph.start[p], graph.start[p + 1]):
                q = graph.neighbours[e]
                if labels[q] == labels[p]:
                    a, b = r, region[q]
                    while parent[a] != a:
                        a = parent[a]
                    while parent[b] != b:
                        b = parent[b]
                    parent[max(a, b)] = min(a, b)
    number = np.empty(regions, np.int32)
    count = 0
    for r in range(regions):
        if parent[r] == r:
            number[r] = count
            count += 1
        else:
            number[r] = number[parent[r]]
    first[: count + 1] = 0
    for p in range(len(region)):
        region[p] = number[region[p]]
        first[region[p] + 1] += 1
    for r in range(count):
        first[r + 1] += first[r]
    place = first[:count].copy()
    for p in range(len(region)):
        order[place[region[p]]] = p
        place[region[p]] += 1
    return number


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
