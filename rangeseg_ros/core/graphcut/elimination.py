"""Minimum cuts of narrow graphs, as bands of pixels are: most nodes need no search.

A node whose excess outweighs its edges together is decided, whatever its neighbours choose, and
what it decides often decides these: partial optimality (persistency). One of two neighbours is
eliminated: what the better of its choices costs depends on theirs alone, and is a cost of each
and an edge between them, so that the graph keeps its kind. Both are exact. What is left, where
many edges cross, is searched (`cut`).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut.cut import minimum_cut


@njit(cache=True, nogil=True)
def best_choice(
    excess: NDArray[np.float64], neighbour: NDArray[np.int32], link: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """What `minimum_cut` returns."""
    excess, neighbour, link = excess.copy(), neighbour.copy(), link.copy()
    chosen = np.zeros(len(excess), np.bool_)
    number, eliminated = _reduce(excess, neighbour, link, chosen)
    rest = np.flatnonzero(number >= 0)
    if len(rest) > 0:
        chosen[rest] = minimum_cut(*_renumbered(rest, number, excess, neighbour, link))
    # Each was eliminated before the neighbours that it had then were decided.
    for s in eliminated[::-1]:
        more = excess[s]
        for k in range(4):
            t = neighbour[s, k]
            if t >= 0:
                more += -link[s, k] if chosen[t] else link[s, k]
        chosen[s] = more < 0
    return chosen


@njit(cache=True, nogil=True)
def _reduce(
    excess: NDArray[np.float64],
    neighbour: NDArray[np.int32],
    link: NDArray[np.float64],
    chosen: NDArray[np.bool_],
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Decide and eliminate nodes until none is left, or all have three neighbours or more.

    In place: `chosen` for those decided, and the graph without them. Returns the numbers (n,) of
    the nodes left among themselves, -1 for the others, and the nodes eliminated, in their order.
    """
    count = len(excess)
    number, eliminated = np.zeros(count, np.int32), np.empty(count, np.int32)
    waiting, queued = np.arange(count).astype(np.int32), np.ones(count, np.bool_)
    last, found = count, 0
    while last > 0:
        last -= 1
        s = waiting[last]
        queued[s] = False
        edges, degree = 0.0, 0
        for k in range(4):
            linked = neighbour[s, k] >= 0
            edges += link[s, k] if linked else 0.0
            degree += linked
        decided = excess[s] >= edges or excess[s] < -edges
        if not decided and degree > 2:
            continue
        number[s] = -1
        if decided:
            chosen[s] = excess[s] < 0
            for k in range(4):
                t = neighbour[s, k]
                if t >= 0:
                    excess[t] += -link[s, k] if chosen[s] else link[s, k]
                    neighbour[t, _side(t, s, neighbour)] = -1
        else:
            _eliminate(s, excess, neighbour, link)
            eliminated[found] = s
            found += 1
        for k in range(4):
            t = neighbour[s, k]
            if t >= 0 and not queued[t]:
                waiting[last], queued[t] = t, True
                last += 1
    left = 0
    for s in range(count):
        if number[s] >= 0:
            number[s] = left
            left += 1
    return number, eliminated[:found]


@njit(cache=True, nogil=True)
def _eliminate(
    s: int, excess: NDArray[np.float64], neighbour: NDArray[np.int32], link: NDArray[np.float64]
) -> None:
    """Let the neighbours of an undecided node, one or two, bear what the better choice costs.

    That is nothing where none of them is chosen, and the excess e where all are.
    """
    first, second = -1, -1
    for k in range(4):
        if neighbour[s, k] >= 0:
            first, second = k, first
    e, p = excess[s], neighbour[s, first]
    side = _side(p, s, neighbour)
    if second < 0:
        excess[p] += e
        neighbour[p, side] = -1
        return
    # Where p alone is chosen, and where q alone is.
    q = neighbour[s, second]
    only_p, only_q = (
        min(link[s, first], e + link[s, second]),
        min(link[s, second], e + link[s, first]),
    )
    excess[p] += (e + only_p - only_q) / 2
    excess[q] += (e + only_q - only_p) / 2
    weight = (only_p + only_q - e) / 2
    other, known = _side(q, s, neighbour), _side(p, q, neighbour)
    if known < 0:
        neighbour[p, side], neighbour[q, other] = q, p
        link[p, side] = link[q, other] = weight
        return
    link[p, known] += weight
    link[q, _side(q, p, neighbour)] += weight
    neighbour[p, side] = neighbour[q, other] = -1


@njit(cache=True, nogil=True)
def _side(p: int, q: int, neighbour: NDArray[np.int32]) -> int:
    """Side of node p that q is on, -1 for none."""
    side = -1
    for k in range(4):
        if neighbour[p, k] == q:
            side = k
    return side


@njit(cache=True, nogil=True)
def _renumbered(
    rest: NDArray[np.intp],
    number: NDArray[np.int32],
    excess: NDArray[np.float64],
    neighbour: NDArray[np.int32],
    link: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
    """The graph of the `rest` of the nodes, which have these numbers."""
    count = len(rest)
    own, beside, links = np.empty(count), np.empty((count, 4), np.int32), np.empty((count, 4))
    for a in range(count):
        s = rest[a]
        own[a] = excess[s]
        for k in range(4):
            t = neighbour[s, k]
            beside[a, k] = number[t] if t >= 0 else np.int32(-1)
            links[a, k] = link[s, k]
    return own, beside, links
