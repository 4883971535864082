"""Where a label could gain among the pieces of an image, and what nothing about takes up."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.octahedral import UNIT
from rangeseg_ros.core.by_normals.piece_graph import Graph
from rangeseg_ros.core.graphcut.expansion import Sites, grouped
from rangeseg_ros.core.graphcut.moves import ROUNDING

# Steps from the pieces of a label that it is tried within.
_NEAR = 4
# What a label must save at a stray, as a share of its links; and half of what the best one saves.
_STRAY = np.float32(0.1)
# Steps that a gain may flow.
_STEPS = 3


@njit(cache=True, nogil=True)
def find_strays(labels: NDArray[np.int32], costs: NDArray[np.uint16], graph: Graph) -> Sites:
    """Pieces that each label suits much better than their own."""
    n, count = costs.shape
    suits, pieces = np.empty(4 * n + count, np.int32), np.empty(4 * n + count, np.int32)
    found = 0
    for p in range(n):
        row = costs[p]
        links = np.float32(0)
        for e in range(graph.start[p], graph.start[p + 1]):
            links += graph.links[e]
        least = row[0]
        for k in range(count):
            least = min(least, row[k])
        own = np.float32(row[labels[p]])
        limit = min(own - _STRAY * links / UNIT, (own + np.float32(least)) / np.float32(2))
        if not least < limit:
            continue
        if found + count > len(suits):
            suits = np.concatenate((suits, np.empty_like(suits)))
            pieces = np.concatenate((pieces, np.empty_like(pieces)))
        for k in range(count):
            if row[k] < limit:
                suits[found], pieces[found] = k, p
                found += 1
    return grouped(suits[:found], pieces[:found], count)


@njit(cache=True)
def widen(
    alpha: int,
    steps: int,
    sites: NDArray[np.int32],
    count: int,
    place: NDArray[np.int32],
    labels: NDArray[np.int32],
    graph: Graph,
) -> int:
    """Add the pieces of other labels within some steps to `sites`; how many they are then.

    `place` is that of each site, -1 elsewhere.
    """
    start, neighbours = graph.start, graph.neighbours
    done = 0
    for _ in range(steps):
        ring = count
        while done < ring:
            p = sites[done]
            done += 1
            for e in range(start[p], start[p + 1]):
                q = neighbours[e]
                if place[q] < 0 and labels[q] != alpha:
                    place[q] = count
                    sites[count] = q
                    count += 1
    return count


@njit(cache=True)
def candidates(
    alpha: int,
    strays: NDArray[np.int32],
    labels: NDArray[np.int32],
    graph: Graph,
    place: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Pieces of other labels that are near to a label, and its strays."""
    start, neighbours = graph.start, graph.neighbours
    sites = np.empty(len(labels), np.int32)
    count = 0
    for p in range(len(labels)):
        if labels[p] == alpha:
            for e in range(start[p], start[p + 1]):
                q = neighbours[e]
                if place[q] < 0 and labels[q] != alpha:
                    place[q] = count
                    sites[count] = q
                    count += 1
    count = widen(alpha, _NEAR - 1, sites, count, place, labels, graph)
    for p in strays:
        if place[p] < 0 and labels[p] != alpha:
            place[p] = count
            sites[count] = p
            count += 1
    for p in sites[:count]:
        place[p] = -1
    return sites[:count]


@njit(cache=True)
def stuck_gains(
    alpha: int,
    tried: NDArray[np.int32],
    excess: NDArray[np.float32],
    labels: NDArray[np.int32],
    graph: Graph,
    flow: NDArray[np.float32],
    pushed: NDArray[np.int32],
) -> tuple[NDArray[np.int32], float]:
    """Pieces of those tried whose gain the pieces about them cannot take up, and what is left.

    Gains (excess below 0) flow by push and relabel (Goldberg and Tarjan, JACM 1988) to pieces
    that lose (above 0), no more than `_STEPS` steps. A flow changes no minimum cut: where
    nothing is stuck, nothing switches. `flow` (m,) is 0 and becomes so again, `pushed` (m,) is
    overwritten.
    """
    start, neighbours, links, back = graph.start, graph.neighbours, graph.links, graph.back
    n = len(labels)
    result, active = np.empty(n, np.int32), np.empty(n, np.int32)
    waits, height = np.zeros(n, np.bool_), np.empty(n, np.int8)
    first = waiting = count = pushes = 0
    # Gains that are not tried count nothing.
    rest = np.maximum(excess, np.float32(0))
    for p in range(n):
        height[p] = rest[p] <= 0
    for p in tried:
        if excess[p] < 0:
            rest[p] = excess[p]
            active[waiting] = p
            waits[p] = True
            waiting += 1
    while waiting:
        p = active[first]
        first = first + 1 if first + 1 < n else 0
        waiting -= 1
        waits[p] = False
        while rest[p] < 0:
            low = _STEPS
            for e in range(start[p], start[p + 1]):
                q = neighbours[e]
                if labels[q] == alpha:
                    continue
                room = links[e] * np.float32(1 if labels[p] == labels[q] else 0.5) - flow[e]
                if room <= np.float32(ROUNDING):
                    continue
                if height[q] >= height[p]:
                    low = min(low, height[q] + 1)
                    continue
                amount = min(room, -rest[p])
                if height[q] == 0:
                    amount = min(amount, rest[q])
                if flow[e] == 0 and flow[back[e]] == 0:
                    pushed[pushes] = e
                    pushes += 1
                flow[e] += amount
                flow[back[e]] -= amount
                rest[p] += amount
                rest[q] -= amount
                if rest[q] <= 0:
                    height[q] = max(height[q], 1)
                    if rest[q] < 0 and not waits[q]:
                        active[(first + waiting) % n] = q
                        waiting += 1
                        waits[q] = True
                if rest[p] > np.float32(-ROUNDING):
                    rest[p] = 0
                    break
                if room > amount:
                    low = min(low, height[q] + 1)
            if rest[p] == 0 or low <= height[p]:
                continue
            height[p] = low
            if low >= _STEPS:
                result[count] = p
                count += 1
                break
    for e in pushed[:pushes]:
        flow[e] = flow[back[e]] = 0
    gain = 0.0
    for p in result[:count]:
        gain -= rest[p]
    return result[:count], gain
