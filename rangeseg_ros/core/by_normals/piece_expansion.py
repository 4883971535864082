"""Expansion of one label over the pieces of an image.

Only where the label could gain is a problem set up: within some steps of the pieces that have it,
and at strays, which it suits much better than their own label. From there gains flow to the
pieces about that lose; where nothing is left over, nothing switches, and only about the rest is
the minimum cut in question (`moves`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.octahedral import UNIT
from rangeseg_ros.core.by_normals.piece_gains import candidates, find_strays, stuck_gains, widen
from rangeseg_ros.core.by_normals.piece_graph import Graph
from rangeseg_ros.core.graphcut.moves import ROUNDING, minimum_cut
from rangeseg_ros.core.runtime.threads import aside

# Gains that are stuck are as much as an expansion can save: it is left if they come to less than
# this share of the energy.
_LEAST = 3e-5
# Steps from where a gain is stuck to pieces that may switch with it.
_REACH = 3


class _State(NamedTuple):
    """Labelling of pieces, and what was worked out about it.

    Attributes
    ----------
    labels : (n,) int32
    data : (n,) float32
        Data cost of each piece's label, degrees.
    unlike : (n,) float32
        Links of each piece to others of another label, summed.
    """

    labels: NDArray[np.int32]
    data: NDArray[np.float32]
    unlike: NDArray[np.float32]


class _Scratch(NamedTuple):
    """Kept from one problem to the next; each leaves `place` at -1 and `flow` at 0.

    Attributes
    ----------
    place : (n,) int32
    flow : (m,) float32
    pushed : (m,) int32
    """

    place: NDArray[np.int32]
    flow: NDArray[np.float32]
    pushed: NDArray[np.int32]


def expand(labels: NDArray[np.int32], costs: NDArray[np.uint16], graph: Graph) -> None:
    """Expand every label in use, the most frequent first.

    Parameters
    ----------
    labels : (n,) int32
        In place.
    costs : (n, K) uint16
        Of each label at each piece, in `UNIT`.
    graph : Graph
    """
    n, count = costs.shape
    m = len(graph.links)
    scratch = _Scratch(np.full(n, -1, np.int32), np.zeros(m, np.float32), np.empty(m, np.int32))
    state = _State(labels, *_sums(labels, costs, graph))
    least = _LEAST * float(state.data.sum() + state.unlike.sum() / 2)
    frequency = np.bincount(labels, minlength=count)
    order = np.argsort(-frequency, kind='stable')[: np.count_nonzero(frequency)]
    pending = aside(_columns, costs, order)
    start, strays = find_strays(labels, costs, graph)
    for alpha, column in zip(order.tolist(), pending.result(), strict=True):
        suited = strays[start[alpha] : start[alpha + 1]]
        sites, excess, first, second, link = _problem(
            alpha, column, suited, least, state, graph, scratch
        )
        if not len(sites):
            continue
        chosen = minimum_cut(excess, first, second, link)
        value = excess[chosen].sum() + link[chosen[first] != chosen[second]].sum()
        if value < -ROUNDING:
            _switch(alpha, sites[chosen], column, state, graph)


@njit(cache=True, nogil=True)
def _columns(costs: NDArray[np.uint16], labels: NDArray[np.integer]) -> NDArray[np.uint16]:
    """Costs of some labels (k,) at every piece, (k, n): each read at a stretch later."""
    n = len(costs)
    columns = np.empty((len(labels), n), np.uint16)
    for p0 in range(0, n, 32):
        for k in range(len(labels)):
            for p in range(p0, min(p0 + 32, n)):
                columns[k, p] = costs[p, labels[k]]
    return columns


@njit(cache=True)
def _sums(
    labels: NDArray[np.int32], costs: NDArray[np.uint16], graph: Graph
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Data cost of each piece's label, and its links to other labels."""
    data, unlike = np.empty(len(labels), np.float32), np.zeros(len(labels), np.float32)
    for p in range(len(labels)):
        data[p] = UNIT * np.float32(costs[p, labels[p]])
        for e in range(graph.start[p], graph.start[p + 1]):
            if labels[graph.neighbours[e]] != labels[p]:
                unlike[p] += graph.links[e]
    return data, unlike


@njit(cache=True)
def _excess(
    alpha: int, column: NDArray[np.uint16], state: _State, graph: Graph
) -> NDArray[np.float32]:
    """What switching costs each piece more than staying, in the terms of `moves`."""
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    half = np.float32(0.5)
    excess = np.empty(len(column), np.float32)
    for p in range(len(column)):
        excess[p] = UNIT * np.float32(column[p]) - state.data[p] - half * state.unlike[p]
    for p in range(len(column)):
        if state.labels[p] == alpha:
            for e in range(start[p], start[p + 1]):
                excess[neighbours[e]] -= half * links[e]
    return excess


@njit(cache=True)
def _problem(
    alpha: int,
    column: NDArray[np.uint16],
    strays: NDArray[np.int32],
    least: float,
    state: _State,
    graph: Graph,
    scratch: _Scratch,
) -> tuple[
    NDArray[np.int32],
    NDArray[np.float64],
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.float64],
]:
    """Pieces that may switch, their excess, ends of the edges between them, and their links.

    None where no more than `least` can be gained.
    """
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    labels, place = state.labels, scratch.place
    excess = _excess(alpha, column, state, graph)
    tried = candidates(alpha, strays, labels, graph, place)
    stuck, gain = stuck_gains(alpha, tried, excess, labels, graph, scratch.flow, scratch.pushed)
    if gain < least:
        stuck = stuck[:0]
    sites = np.empty(len(labels) if len(stuck) else 0, np.int32)
    for s in range(len(stuck)):
        sites[s] = stuck[s]
        place[stuck[s]] = s
    count = widen(alpha, _REACH, sites, len(stuck), place, labels, graph)
    room = 0
    for p in sites[:count]:
        room += start[p + 1] - start[p]
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
            if place[q] < 0:
                price[s] += u
            elif s < place[q]:
                first[edges], second[edges], link[edges] = s, place[q], u
                edges += 1
    for p in sites[:count]:
        place[p] = -1
    return sites[:count], price, first[:edges], second[:edges], link[:edges]


@njit(cache=True)
def _switch(
    alpha: int,
    sites: NDArray[np.int32],
    column: NDArray[np.uint16],
    state: _State,
    graph: Graph,
) -> None:
    """Give pieces a label."""
    labels, data, unlike = state.labels, state.data, state.unlike
    start, neighbours, links = graph.start, graph.neighbours, graph.links
    for p in sites:
        data[p] = UNIT * np.float32(column[p])
        for e in range(start[p], start[p + 1]):
            q = neighbours[e]
            change = np.float32(labels[q] != alpha) - np.float32(labels[q] != labels[p])
            unlike[p] += change * links[e]
            unlike[q] += change * links[e]
        labels[p] = alpha
