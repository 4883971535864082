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
