"""Expansion of one label by the sites around it: thesis 4.8 where the outcome is in question.

Sites are pixels, numbered in raster order. A site whose data speak louder than all of its
neighbours together is decided without a cut, and what it decides often decides its neighbours:
partial optimality, and exact. The rest is a minimum cut (`cut`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut.cut import minimum_cut
from rangeseg_ros.core.sensing.grid import CHUNK

Sites = tuple[NDArray[np.int64], NDArray[np.int32]]
"""Of each label: start (K + 1,) and sites (N,), label k's from start[k] to start[k + 1]."""


class GridLabelling(NamedTuple):
    """A labelling of n pixels, in raster order, while expansions change it.

    Attributes
    ----------
    labels : (n,) int32
    data : (n,) float32
        Data cost of each pixel's label.
    links : (2, n) float32
        See `energy.link_costs`.
    width : int
        Pixels in a row.
    position : (n,) int32
        Scratch of the expansions: -1 between them.
    """

    labels: NDArray[np.int32]
    data: NDArray[np.float32]
    links: NDArray[np.float32]
    width: int
    position: NDArray[np.int32]

    @classmethod
    def of(
        cls,
        labels: NDArray[np.int32],
        data: NDArray[np.float32],
        links: NDArray[np.float32],
        width: int,
    ) -> GridLabelling:
        """Begin with these labels and data costs, which change in place."""
        return cls(labels, data, links, width, np.full(len(labels), -1, np.int32))


@njit(cache=True, nogil=True)
def fronts(
    labels: NDArray[np.int32],
    links: NDArray[np.float32],
    width: int,
    count: int,
    rows: tuple[int, int],
) -> Sites:
    """Sites in some rows that are across an edge from each label's own.

    Parameters
    ----------
    labels : (n,) int32
    links : (2, n) float32
    width : int
        Sites in a row.
    count : int
        Number of labels.
    rows : tuple of 2 int
        The first of the rows, and the one after the last.
    """
    first, after = rows[0] * width, rows[1] * width
    room = 4 * (after - first)
    beside, sites = np.empty(room, np.int32), np.empty(room, np.int32)
    found = 0
    for chunk in range(max(first - width, 0), after, CHUNK):
        stop = min(chunk + CHUNK, after)
        if are_alike(labels, chunk, stop, width):
            continue
        for p in range(chunk, stop):
            here = labels[p]
            for k in range(2):
                q = p + (1 if k == 0 else width)
                if q < len(labels) and labels[q] != here and links[k, p] > 0:
                    if first <= q < after:
                        beside[found], sites[found] = here, q
                        found += 1
                    if p >= first:
                        beside[found], sites[found] = labels[q], p
                        found += 1
    return group_sites(beside[:found], sites[:found], count)


@njit(cache=True, nogil=True)
def are_alike(labels: NDArray[np.int32], first: int, after: int, width: int) -> bool:
    """Whether sites from `first` to before `after` have the labels of those right of and below
    them, where there are any; `width` sites are in a row."""
    # As views of their own, whose places are known not to be negative, many are compared at once.
    here = labels[first:after]
    right, below = labels[first + 1 : after + 1], labels[first + width : after + width]
    unlike = here[0] ^ here[0]
    for p in range(len(right)):
        unlike |= here[p] ^ right[p]
    for p in range(len(below)):
        unlike |= here[p] ^ below[p]
    return bool(unlike == 0)


@njit(cache=True, nogil=True)
def group_sites(labels: NDArray[np.int32], sites: NDArray[np.int32], count: int) -> Sites:
    """Sort sites (N,) by their labels (N,), which are below `count`; of a label in order."""
    start = np.zeros(count + 2, np.int64)
    for label in labels:
        start[label + 2] += 1
    start = np.cumsum(start)
    result = np.empty_like(sites)
    for s in range(len(sites)):
        result[start[labels[s] + 1]] = sites[s]
        start[labels[s] + 1] += 1
    return start[: count + 1], result


@njit(cache=True, nogil=True)
def band(
    alpha: int,
    front: NDArray[np.int32],
    reach: int,
    labelling: GridLabelling,
    rows: tuple[int, int],
) -> NDArray[np.int32]:
    """Sites of other labels, in some rows, within `reach` edges of a label.

    Parameters
    ----------
    alpha : int
    front : (m,) int32
        Sites next to those of the label.
    reach : int
    labelling : GridLabelling
        `position` receives the place of each site in the result.
    rows : tuple of 2 int
        The first of the rows, and the one after the last.

    Returns
    -------
    (s,) int32
    """
    labels, links, position = labelling.labels, labelling.links, labelling.position
    offsets = np.array([1, labelling.width, -1, -labelling.width])
    first, after = rows[0] * labelling.width, rows[1] * labelling.width
    sites = np.empty(max(64, 2 * reach * len(front)), np.int32)
    count = done = 0
    for p in front:
        if labels[p] != alpha and position[p] < 0:
            position[p] = count
            sites[count] = p
            count += 1
    for _ in range(reach - 1):
        ring = count
        while done < ring:
            p = sites[done]
            done += 1
            for k in range(4):
                q = p + offsets[k]
                linked = first <= q < after and links[k % 2, min(p, q)] > 0
                if linked and labels[q] != alpha and position[q] < 0:
                    if count == len(sites):
                        sites = np.concatenate((sites, np.empty_like(sites)))
                    position[q] = count
                    sites[count] = q
                    count += 1
    return sites[:count]


@njit(cache=True, nogil=True)
def beyond(
    alpha: int, sites: NDArray[np.int32], labelling: GridLabelling, rows: tuple[int, int]
) -> NDArray[np.int32]:
    """Sites beyond a band that the label has won up to its far side, in some rows.

    They are next to a site of the band that has the label by now, and neither in the band nor of
    the label themselves.
    """
    labels, links, position = labelling.labels, labelling.links, labelling.position
    offsets = np.array([1, labelling.width, -1, -labelling.width])
    first, after = rows[0] * labelling.width, rows[1] * labelling.width
    for p in sites:
        position[p] = 0
    result = np.empty(3 * len(sites), np.int32)
    count = 0
    for p in sites:
        if labels[p] != alpha:
            continue
        for k in range(4):
            q = p + offsets[k]
            linked = first <= q < after and links[k % 2, min(p, q)] > 0
            if linked and labels[q] != alpha and position[q] < 0:
                result[count] = q
                count += 1
    for p in sites:
        position[p] = -1
    return result[:count]


@njit(cache=True, nogil=True)
def expand(
    alpha: int,
    sites: NDArray[np.int32],
    new: NDArray[np.float32],
    labelling: GridLabelling,
    least: float,
) -> bool:
    """Give label `alpha` to the best set of sites; in place.

    Parameters
    ----------
    alpha : int
    sites : (s,) int32
        Those that may switch, none of which has the label. `labelling.position` has their places.
    new : (s,) float32
        Data cost of the label there.
    labelling : GridLabelling
    least : float
        An improvement of no more than this is rounding.

    Returns
    -------
    bool
        Whether that lowered the energy.
    """
    excess, neighbour, link = _problem(alpha, sites, new, labelling)
    count = len(sites)
    switch = np.zeros(count, np.bool_)
    is_open, value = _decide(excess, neighbour, link, switch)
    # What is left, numbered anew.
    number = np.cumsum(is_open) - 1
    rest = np.flatnonzero(is_open)
    if len(rest):
        beside = np.full((len(rest), 4), -1, np.int32)
        for a in range(len(rest)):
            for k in range(4):
                t = neighbour[rest[a], k]
                if t >= 0:
                    beside[a, k] = number[t]
        link, excess = link[rest], excess[rest]
        chosen = minimum_cut(excess, beside, link)
        for a in range(len(rest)):
            switch[rest[a]] = chosen[a]
            if not chosen[a]:
                continue
            value += excess[a]
            for k in range(4):
                if beside[a, k] >= 0 and not chosen[beside[a, k]]:
                    value += link[a, k]
    if value >= -least:
        return False
    for s in range(count):
        if switch[s]:
            labelling.labels[sites[s]] = alpha
            labelling.data[sites[s]] = new[s]
    return True


@njit(cache=True, nogil=True)
def _problem(
    alpha: int, sites: NDArray[np.int32], new: NDArray[np.float32], labelling: GridLabelling
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
    """What switching costs each site more than staying, and its edges to other sites.

    (s,), and neighbours and weights as of `minimum_cut`. Clears `labelling.position`.
    """
    labels, links, position = labelling.labels, labelling.links, labelling.position
    offsets = np.array([1, labelling.width, -1, -labelling.width])
    count = len(sites)
    excess = np.empty(count)
    link = np.zeros((count, 4))
    neighbour = np.full((count, 4), -1, np.int32)
    for s in range(count):
        p = sites[s]
        here = labels[p]
        total = np.float64(new[s]) - np.float64(labelling.data[p])
        for k in range(4):
            q = p + offsets[k]
            u = np.float64(links[k % 2, min(p, q)])
            if u == 0:
                continue
            there, t = labels[q], position[q]
            if t >= 0:
                if here != there:
                    u /= 2
                    total -= u
                neighbour[s, k], link[s, k] = t, u
            elif there == alpha:
                total -= u
            elif there == here:
                total += u
        excess[s] = total
    for p in sites:
        position[p] = -1
    return excess, neighbour, link


@njit(cache=True, nogil=True)
def _decide(
    excess: NDArray[np.float64],
    neighbour: NDArray[np.int32],
    link: NDArray[np.float64],
    switch: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], float]:
    """Decide the sites whose excess outweighs their undecided neighbours together.

    In place: `switch` for those decided, for the others `excess` and `neighbour` without them.
    Also returns which are open, (s,), and the change of the energy by the decided ones.
    """
    count = len(excess)
    pairwise = link.sum(axis=1)
    is_open = np.ones(count, np.bool_)
    waiting = np.empty(count, np.int32)
    last = done = 0
    for s in range(count):
        if excess[s] >= pairwise[s] or excess[s] < -pairwise[s]:
            waiting[last] = s
            is_open[s] = False
            last += 1
    value = 0.0
    while done < last:
        s = waiting[done]
        done += 1
        switch[s] = excess[s] < 0
        if switch[s]:
            value += excess[s]
        for k in range(4):
            t, u = neighbour[s, k], link[s, k]
            if t < 0:
                continue
            neighbour[t, (k + 2) % 4] = -1
            pairwise[t] -= u
            if switch[s]:
                value += u
                excess[t] -= u
            else:
                excess[t] += u
            if is_open[t] and (excess[t] >= pairwise[t] or excess[t] < -pairwise[t]):
                waiting[last] = t
                is_open[t] = False
                last += 1
    return is_open, value
