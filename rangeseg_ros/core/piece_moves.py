"""Labelling the pieces of an image: regions take labels as wholes, then labels are expanded."""

from __future__ import annotations

from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.moves import ROUNDING, minimum_cut
from rangeseg_ros.core.pieces import UNIT, Pieces
from rangeseg_ros.core.threads import aside

# Steps that a gain may flow, and from where it is stuck to pieces that may switch with it.
_STEPS, _REACH = 4, 3

# Sites, excess, ends of the edges and their links, in the terms of `moves.minimum_cut`.
_Binary = tuple[
    NDArray[np.int32],
    NDArray[np.float64],
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.float64],
]


class Graph(NamedTuple):
    """Edges between pieces, see `Pieces`, listed from both ends.

    Attributes
    ----------
    start, neighbours, links : (n + 1,) int32, (m,) int32, (m,) float32
    back : (m,) int32
        Where each edge is listed from its other end.
    """

    start: NDArray[np.int32]
    neighbours: NDArray[np.int32]
    links: NDArray[np.float32]
    back: NDArray[np.int32]


class PieceLabelling:
    """A labelling of pieces while its energy is minimised.

    Parameters
    ----------
    pieces : Pieces
    labels : (n,) int32
        Labelling to start from.

    Attributes
    ----------
    labels : (n,) int32
    """

    def __init__(self, pieces: Pieces, labels: NDArray[np.int32]) -> None:
        self.labels = labels
        self._costs = pieces.costs
        back = _back(pieces.start, pieces.neighbours)
        self._graph = Graph(pieces.start, pieces.neighbours, pieces.links, back)
        n = len(labels)
        # Of two problems: place of a piece in it, height and flow of `_stuck`.
        self._scratch = [
            (
                np.full(n, -1, np.int32),
                np.zeros(n, np.int32),
                np.zeros(len(pieces.links), np.float32),
            )
            for _ in range(2)
        ]
        # When a piece or one within two steps changed last, and when a label was tried last.
        self._changed = np.ones(n, np.int32)
        self._tried = np.zeros(self._costs.shape[1], np.int32)
        self._time = 1

    def settle(self) -> None:
        """Give every piece in turn the label, its own or a neighbour's, that costs least."""
        _settle(self.labels, self._costs, self._graph)

    def turn(self) -> None:
        """Give every region in turn the label that costs least, until that changes nothing."""
        before = self.labels.copy()
        _turn(self.labels, self._costs, self._graph)
        self._time += 1
        changed = np.flatnonzero(self.labels != before)
        _mark(changed, self._changed, self._time, self._graph)

    def expand(self) -> None:
        """Expand every label in use, the most frequent first.

        Problems are set up two at a time; the second is set up anew if the first move changed
        what it is about.
        """
        frequency = np.bincount(self.labels, minlength=self._costs.shape[1])
        order = np.argsort(-frequency, kind='stable')[: np.count_nonzero(frequency)].tolist()
        self._data = _own(self.labels, self._costs)
        self._unlike = _unlike(self.labels, self._graph)
        for alpha, beta in zip_longest(order[::2], order[1::2]):
            pending = None if beta is None else aside(self._problem, beta, 1)
            self._switch(alpha, self._problem(alpha, 0))
            if pending is not None:
                problem = pending.result()
                if (self._changed[problem[0]] == self._time).any():
                    problem = self._problem(beta, 1)
                self._switch(beta, problem)

    def _problem(self, alpha: int, place: int) -> _Binary:
        return _expansion(
            alpha,
            self._costs,
            self.labels,
            self._data,
            self._unlike,
            *self._scratch[place],
            self._graph,
            self._changed,
            self._tried[alpha],
        )

    def _switch(self, alpha: int, problem: _Binary) -> None:
        """Make the best move."""
        sites, excess, first, second, link = problem
        self._tried[alpha] = self._time
        self._time += 1
        if not len(sites):
            return
        chosen = minimum_cut(excess, first, second, link)
        value = excess[chosen].sum() + link[chosen[first] != chosen[second]].sum()
        if value < -ROUNDING:
            switched = sites[chosen]
            _switch(
                alpha, switched, self._costs, self.labels, self._data, self._unlike, self._graph
            )
            _mark(switched, self._changed, self._time, self._graph)


@njit(cache=True)
def _back(start: NDArray[np.int32], neighbours: NDArray[np.int32]) -> NDArray[np.int32]:
    """Where each edge is listed from its other end."""
    back = np.empty(len(neighbours), np.int32)
    for p in range(len(start) - 1):
        for e in range(start[p], start[p + 1]):
            f = start[neighbours[e]]
            while neighbours[f] != p:
                f += 1
            back[e] = f
    return back


@njit(cache=True)
def _own(labels: NDArray[np.int32], costs: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Data cost of each piece's label, degrees."""
    data = np.empty(len(labels), np.float32)
    for p in range(len(labels)):
        data[p] = UNIT * np.float32(costs[p, labels[p]])
    return data


@njit(cache=True)
def _unlike(
    labels: NDArray[np.int32],
    graph: Graph,
) -> NDArray[np.float32]:
    """Links of each piece to others of another label, summed."""
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    total = np.zeros(len(labels), np.float32)
    for p in range(len(labels)):
        for e in range(start[p], start[p + 1]):
            if labels[neighbours[e]] != labels[p]:
                total[p] += links[e]
    return total


@njit(cache=True)
def _settle(
    labels: NDArray[np.int32],
    costs: NDArray[np.uint16],
    graph: Graph,
) -> None:
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
def _turn(
    labels: NDArray[np.int32],
    costs: NDArray[np.uint16],
    graph: Graph,
) -> None:
    """Regions that took the same label grow together and then turn as one."""
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


@njit(cache=True, nogil=True)
def _stuck(
    alpha: int,
    excess: NDArray[np.float32],
    labels: NDArray[np.int32],
    height: NDArray[np.int32],
    flow: NDArray[np.float32],
    graph: Graph,
    sites: NDArray[np.int32],
) -> int:
    """Pieces whose gain the pieces about them cannot take up, in `sites`; how many.

    Gains (excess below 0) flow by push and relabel (Goldberg and Tarjan, JACM 1988) to pieces
    that lose (above 0), no more than `_STEPS` steps. A flow changes no minimum cut: where
    nothing is stuck, nothing switches. `flow` is 0 and becomes so again.
    """
    start, neighbours, links, back = graph.start, graph.neighbours, graph.links, graph.back
    n = len(labels)
    active = np.empty(n, np.int32)
    waits = np.zeros(n, np.bool_)
    touched = np.empty(len(links), np.int32)
    first = waiting = count = pushes = 0
    for p in range(n):
        height[p] = excess[p] <= 0
        if excess[p] < 0:
            active[waiting] = p
            waits[p] = True
            waiting += 1
    while waiting:
        p = active[first]
        first = (first + 1) % n
        waiting -= 1
        waits[p] = False
        while excess[p] < 0:
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
                amount = min(room, -excess[p])
                if height[q] == 0:
                    amount = min(amount, excess[q])
                if flow[e] == 0 and flow[back[e]] == 0:
                    touched[pushes] = e
                    pushes += 1
                flow[e] += amount
                flow[back[e]] -= amount
                excess[p] += amount
                excess[q] -= amount
                if excess[q] <= 0:
                    height[q] = max(height[q], 1)
                    if excess[q] < 0 and not waits[q]:
                        active[(first + waiting) % n] = q
                        waiting += 1
                        waits[q] = True
                if excess[p] > np.float32(-ROUNDING):
                    excess[p] = 0
                    break
                if room > amount:
                    low = min(low, height[q] + 1)
            if excess[p] == 0 or low <= height[p]:
                continue
            height[p] = low
            if low >= _STEPS:
                sites[count] = p
                count += 1
                break
    for k in range(pushes):
        e = touched[k]
        flow[e] = flow[back[e]] = 0
    return count


@njit(cache=True, nogil=True)
def _expansion(
    alpha: int,
    costs: NDArray[np.uint16],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
    unlike: NDArray[np.float32],
    position: NDArray[np.int32],
    height: NDArray[np.int32],
    flow: NDArray[np.float32],
    graph: Graph,
    changed: NDArray[np.int32],
    tried: int,
) -> _Binary:
    """Pieces about those that gain, and their binary problem in the terms of `moves`.

    What gained too little when the label was tried last, and has not changed since, is not tried
    again.
    """
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    n = len(labels)
    half = np.float32(0.5)
    excess = np.empty(n, np.float32)
    for p in range(n):
        excess[p] = UNIT * np.float32(costs[p, alpha]) - data[p] - half * unlike[p]
    for p in range(n):
        if labels[p] == alpha:
            for e in range(start[p], start[p + 1]):
                excess[neighbours[e]] -= half * links[e]
    gain = excess.copy()
    for p in range(n):
        if labels[p] == alpha or (gain[p] < 0 and changed[p] <= tried):
            gain[p] = 0
    sites = np.empty(n, np.int32)
    count = _stuck(alpha, gain, labels, height, flow, graph, sites)
    for s in range(count):
        position[sites[s]] = s
    done = room = 0
    for _ in range(_REACH):
        ring = count
        while done < ring:
            p = sites[done]
            done += 1
            for e in range(start[p], start[p + 1]):
                q = neighbours[e]
                if position[q] < 0 and labels[q] != alpha:
                    position[q] = count
                    sites[count] = q
                    count += 1
    for s in range(count):
        room += start[sites[s] + 1] - start[sites[s]]
    price = np.empty(count)
    first, second, link = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room)
    edges = 0
    for s in range(count):
        p = sites[s]
        price[s] = excess[p]
        for e in range(start[p], start[p + 1]):
            q = neighbours[e]
            if labels[q] == alpha:
                continue
            u = np.float64(links[e]) * (1 if labels[p] == labels[q] else 0.5)
            if position[q] < 0:
                price[s] += u
            elif s < position[q]:
                first[edges], second[edges], link[edges] = s, position[q], u
                edges += 1
    for s in range(count):
        position[sites[s]] = -1
    return sites[:count], price, first[:edges], second[:edges], link[:edges]


@njit(cache=True)
def _switch(
    alpha: int,
    sites: NDArray[np.int32],
    costs: NDArray[np.uint16],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
    unlike: NDArray[np.float32],
    graph: Graph,
) -> None:
    """Give pieces a label; keeps `data` and `unlike` up to date."""
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    for p in sites:
        data[p] = UNIT * np.float32(costs[p, alpha])
        for e in range(start[p], start[p + 1]):
            q = neighbours[e]
            change = np.float32(labels[q] != alpha) - np.float32(labels[q] != labels[p])
            unlike[p] += change * links[e]
            unlike[q] += change * links[e]
        labels[p] = alpha


@njit(cache=True)
def _mark(
    sites: NDArray[np.integer],
    changed: NDArray[np.int32],
    time: int,
    graph: Graph,
) -> None:
    """Note that pieces changed, also for those within two steps."""
    start, neighbours = graph.start, graph.neighbours
    for p in sites:
        changed[p] = time
        for e in range(start[p], start[p + 1]):
            q = neighbours[e]
            changed[q] = time
            for f in range(start[q], start[q + 1]):
                changed[neighbours[f]] = time
