"""Expansions as minimum cuts (thesis 4.7, 4.8; Boykov, Veksler and Zabih, TPAMI 2001).

An expansion is a binary problem: a free pixel p switches to alpha (x_p = 1) or stays (x_p = 0),
and the best set of pixels to switch is a minimum cut. An edge of weight w between pixels of
unlike labels, neither of them alpha, costs w unless both ends switch, and

    w (1 - x_p x_q) = w/2 (1 - x_p) + w/2 (1 - x_q) + w/2 |x_p - x_q|,

so that it becomes an n-link of w/2 and a cost w/2 of staying at each end: no auxiliary vertex
(thesis 4.7.2) is needed. An edge between like labels is an n-link of w. With a neighbour q that
is not free, x_q is known, 1 if it has the label alpha and 0 otherwise, and the n-link becomes a
cost of staying or of switching.

The cut is found by the algorithm of Boykov and Kolmogorov (TPAMI 2004), made for such grids: a
tree grows from the sink over edges that are not saturated; where it meets a node that the source
feeds, flow is pushed along the path, and nodes that this cuts off look for another parent in their
tree. The tree of the source need not grow, as most nodes stay.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Ints, Mask

# Parents that are not a neighbour: those have the number of their side, 0 to 3.
_TERMINAL, _ORPHAN, _FREE = 4, 5, 6


class _Flow(NamedTuple):
    """State of a maximum flow: n nodes with up to four neighbours.

    The source stands for staying, the sink for switching.
    """

    neighbour: Ints  # (n, 4), node on each side, -1 for none
    residual: Floats  # (n, 4), what the edge to that side can still take
    terminal: Floats  # (n,), that of the source, of the sink where negative
    parent: NDArray[np.int8]  # (n,), side of the parent in its tree
    sink: Mask  # (n,), whether the tree is that of the sink
    stamp: Ints  # (n,), when the distance to the terminal was last known
    depth: Ints  # (n,), that distance
    queue: Ints  # (n,), ring of the nodes from which the trees grow
    queued: Mask  # (n,), whether a node is in it


@njit(cache=True, nogil=True)
def minimum_cut(excess: Floats, neighbour: Ints, link: Floats) -> Mask:
    """Choice x (n,) bool that minimises sum excess x + sum link |x - x of the neighbour|.

    Of several, the one that chooses fewest nodes. `excess` (n,) is the cost of choosing a node, of
    either sign. `neighbour` (n, 4) are the nodes on each side of a grid, -1 for none: that node
    has this one on the opposite side, k ^ 2 for side k. `link` (n, 4) is the cost, not negative,
    of the edge to that side if its ends are not chosen alike; the same seen from either end.
    """
    count = len(excess)
    flow = _Flow(
        neighbour,
        link.copy(),
        excess.copy(),
        np.full(count, _FREE, np.int8),
        np.zeros(count, np.bool_),
        np.zeros(count, np.int32),
        np.zeros(count, np.int32),
        np.zeros(count, np.int32),
        np.zeros(count, np.bool_),
    )
    orphans = np.empty(count, np.int32)
    first = last = 0
    for p in range(count):
        if flow.terminal[p] != 0:
            flow.parent[p], flow.sink[p], flow.depth[p] = _TERMINAL, flow.terminal[p] < 0, 1
            if flow.sink[p]:
                last = _wait(flow, p, last)
    time = 0
    while count > 0 and flow.queued[flow.queue[first]]:
        p = flow.queue[first]
        side = -1
        if flow.parent[p] != _FREE:
            # Grow the tree from p, until it meets the other one.
            for k in range(4):
                q = neighbour[p, k]
                if q < 0:
                    continue
                opposite = k ^ 2
                if flow.residual[q, opposite] <= 0:
                    continue
                if flow.parent[q] == _FREE:
                    flow.parent[q], flow.sink[q] = opposite, True
                    flow.stamp[q], flow.depth[q] = flow.stamp[p], flow.depth[p] + 1
                    last = _wait(flow, q, last)
                elif not flow.sink[q]:
                    side = k
                    break
                elif flow.stamp[q] <= flow.stamp[p] and flow.depth[q] > flow.depth[p]:
                    flow.parent[q] = opposite
                    flow.stamp[q], flow.depth[q] = flow.stamp[p], flow.depth[p] + 1
        if side < 0:
            # Nothing more to grow here.
            flow.queued[p] = False
            first = _next(first, count)
            continue
        time += 1
        found = _push(flow, p, side, orphans)
        # Orphans look for parents; those that find none leave orphans of their own.
        done, end = 0, _next(found - 1, count)
        while found > 0:
            q = orphans[done]
            done = _next(done, count)
            found -= 1
            if _adopt(flow, q, time):
                continue
            for k in range(4):
                r = neighbour[q, k]
                if r < 0 or flow.parent[r] == _FREE or flow.sink[r] != flow.sink[q]:
                    continue
                opposite = k ^ 2
                if flow.sink[q] and flow.residual[q, k] > 0:
                    last = _wait(flow, r, last)
                if flow.parent[r] == opposite:
                    flow.parent[r] = _ORPHAN
                    orphans[end] = r
                    end = _next(end, count)
                    found += 1
            flow.parent[q] = _FREE
    chosen = np.empty(count, np.bool_)
    for p in range(count):
        chosen[p] = flow.parent[p] != _FREE and flow.sink[p]
    return chosen


@njit(cache=True, nogil=True, inline='always')
def _next(place: int, count: int) -> int:
    """Place after another in a ring."""
    return place + 1 if place + 1 < count else 0


@njit(cache=True, nogil=True, inline='always')
def _wait(flow: _Flow, p: int, last: int) -> int:
    """Let a node wait in the queue, unless it does; the new end of the queue."""
    if flow.queued[p]:
        return last
    flow.queue[last], flow.queued[p] = p, True
    return _next(last, len(flow.queue))


@njit(cache=True, nogil=True)
def _push(flow: _Flow, p: int, side: int, orphans: Ints) -> int:
    """Push what the path over this edge of a sink node can take; how many `orphans` that makes."""
    neighbour, residual = flow.neighbour, flow.residual
    terminal, parent = flow.terminal, flow.parent
    p, side = neighbour[p, side], side ^ 2
    pushed = residual[p, side]
    # From p up to the source, against the flow, and from its neighbour on to the sink.
    for sink in range(2):
        a = neighbour[p, side] if sink else p
        while parent[a] != _TERMINAL:
            k = parent[a]
            above = neighbour[a, k]
            pushed = min(pushed, residual[a, k] if sink else residual[above, k ^ 2])
            a = above
        pushed = min(pushed, abs(terminal[a]))
    found = 0
    residual[p, side] -= pushed
    residual[neighbour[p, side], side ^ 2] += pushed
    for sink in range(2):
        a = neighbour[p, side] if sink else p
        way = pushed if sink else -pushed
        while parent[a] != _TERMINAL:
            k = parent[a]
            above = neighbour[a, k]
            residual[a, k] -= way
            residual[above, k ^ 2] += way
            if (residual[a, k] if sink else residual[above, k ^ 2]) <= 0:
                parent[a] = _ORPHAN
                orphans[found] = a
                found += 1
            a = above
        terminal[a] += way
        if terminal[a] == 0:
            parent[a] = _ORPHAN
            orphans[found] = a
            found += 1
    return found


@njit(cache=True, nogil=True)
def _adopt(flow: _Flow, p: int, time: int) -> bool:
    """Find an orphan the nearest parent of its tree that still leads to the terminal."""
    neighbour, parent, stamp, depth = flow.neighbour, flow.parent, flow.stamp, flow.depth
    best = -1
    least = np.int32(2147483647)
    for k in range(4):
        q = neighbour[p, k]
        if q < 0 or parent[q] == _FREE or flow.sink[q] != flow.sink[p]:
            continue
        free = flow.residual[p, k] if flow.sink[p] else flow.residual[q, k ^ 2]
        if free <= 0:
            continue
        steps, r = np.int32(0), q
        while True:
            if stamp[r] == time:
                steps += depth[r]
                break
            steps += 1
            if parent[r] == _TERMINAL:
                stamp[r], depth[r] = time, 1
                break
            if parent[r] == _ORPHAN:
                steps = np.int32(-1)
                break
            r = neighbour[r, parent[r]]
        if steps < 0:
            continue
        if steps < least:
            least, best = steps, k
        # What was learnt on the way is kept.
        r = q
        while stamp[r] != time:
            stamp[r], depth[r] = time, steps
            steps -= 1
            r = neighbour[r, parent[r]]
    if best < 0:
        return False
    parent[p], stamp[p], depth[p] = best, time, least + 1
    return True
