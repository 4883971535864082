"""Expansion of one label by the sites around it: thesis 4.8 where the outcome is in question.

A site whose data speak louder than all of its
neighbours together is decided without a cut, and what it decides often decides its neighbours:
partial optimality, and exact. The rest is a minimum cut (`cut`).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut.cut import minimum_cut
from rangeseg_ros.core.graphcut.sites import GridLabelling


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
    excess, around, neighbour, link = _problem(alpha, sites, new, labelling)
    count = len(sites)
    switch = np.zeros(count, np.bool_)
    number, value = _decide(excess, around, neighbour, link, switch)
    rest = np.flatnonzero(number >= 0)
    if len(rest):
        excess, neighbour, link = _renumbered(rest, number, excess, neighbour, link)
        chosen = minimum_cut(excess, neighbour, link)
        for a in range(len(rest)):
            switch[rest[a]] = chosen[a]
            if not chosen[a]:
                continue
            value += excess[a]
            for k in range(4):
                if neighbour[a, k] >= 0 and not chosen[neighbour[a, k]]:
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
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
    """What switching costs each site more than staying, and its edges to other sites.

    (s,), the sums of the edges (s,), and neighbours and weights as of `minimum_cut`. Clears
    `labelling.position`.
    """
    labels, links, position = labelling.labels, labelling.links, labelling.position
    offsets = 1, labelling.width, -1, -labelling.width
    count = len(sites)
    excess, around = np.empty(count), np.empty(count)
    neighbour, link = np.empty((count, 4), np.int32), np.empty((count, 4))
    for s in range(count):
        p = sites[s]
        here = labels[p]
        total, edges = np.float64(new[s]) - np.float64(labelling.data[p]), 0.0
        for k in range(4):
            q = p + offsets[k]
            u, t = np.float64(links[k % 2, min(p, q)]), np.int32(-1)
            if u != 0:
                there, t = labels[q], position[q]
                if t >= 0 and here != there:
                    u *= np.float64(0.5)
                    total -= u
                elif t < 0:
                    total += u if there == here else -u if there == alpha else np.float64(0)
                    u = np.float64(0)
            neighbour[s, k], link[s, k] = t, u
            edges += u
        excess[s], around[s] = total, edges
    for p in sites:
        position[p] = -1
    return excess, around, neighbour, link


@njit(cache=True, nogil=True)
def _decide(
    excess: NDArray[np.float64],
    around: NDArray[np.float64],
    neighbour: NDArray[np.int32],
    link: NDArray[np.float64],
    switch: NDArray[np.bool_],
) -> tuple[NDArray[np.int32], float]:
    """Decide the sites whose excess outweighs their undecided neighbours together.

    In place: `switch` for those decided, for the others `excess` and `neighbour` without them.
    Also returns the numbers (s,) of the others among themselves, -1 for those decided, and the
    change of the energy by these.
    """
    count = len(excess)
    number = np.zeros(count, np.int32)
    waiting = np.empty(count, np.int32)
    last = done = 0
    for s in range(count):
        if excess[s] >= around[s] or excess[s] < -around[s]:
            waiting[last], number[s] = s, -1
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
            around[t] -= u
            if switch[s]:
                value += u
                excess[t] -= u
            else:
                excess[t] += u
            if number[t] >= 0 and (excess[t] >= around[t] or excess[t] < -around[t]):
                waiting[last], number[t] = t, -1
                last += 1
    left = 0
    for s in range(count):
        if number[s] >= 0:
            number[s] = left
            left += 1
    return number, value


@njit(cache=True, nogil=True)
def _renumbered(
    rest: NDArray[np.intp],
    number: NDArray[np.int32],
    excess: NDArray[np.float64],
    neighbour: NDArray[np.int32],
    link: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
    """The problem of `minimum_cut` of the `rest` of the sites, which have these numbers."""
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
