"""Expansion of one label by the sites around it: thesis 4.8 where the outcome is in question."""

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
    """Give label `alpha` to the best set of sites (s,), none of which has it; in place.

    `labelling.position` has their places, `new` (s,) is the data cost of the label there. Returns
    whether that lowered the energy by more than `least`, which is rounding.
    """
    excess, neighbour, link = switching(alpha, sites, new, labelling)
    switch = minimum_cut(excess, neighbour, link)
    if change(switch, excess, neighbour, link) >= -least:
        return False
    for s in range(len(sites)):
        if switch[s]:
            labelling.labels[sites[s]] = alpha
            labelling.data[sites[s]] = new[s]
    return True


@njit(cache=True, nogil=True)
def change(
    switch: NDArray[np.bool_],
    excess: NDArray[np.float64],
    neighbour: NDArray[np.int32],
    link: NDArray[np.float64],
) -> float:
    """What the energy changes by where sites (s,) `switch`; the others as of `minimum_cut`."""
    value = 0.0
    for s in range(len(switch)):
        if not switch[s]:
            continue
        value += excess[s]
        for k in range(4):
            if neighbour[s, k] >= 0 and not switch[neighbour[s, k]]:
                value += link[s, k]
    return value


@njit(cache=True, nogil=True)
def switching(
    alpha: int, sites: NDArray[np.int32], new: NDArray[np.float32], labelling: GridLabelling
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
    """What switching costs each site more than staying, and its edges to other sites.

    (s,), and neighbours and weights as of `minimum_cut`. Clears `labelling.position`.
    """
    labels, links, position = labelling.labels, labelling.links, labelling.position
    offsets = 1, labelling.width, -1, -labelling.width
    count = len(sites)
    excess = np.empty(count)
    neighbour, link = np.empty((count, 4), np.int32), np.empty((count, 4))
    for s in range(count):
        p = sites[s]
        here = labels[p]
        total = np.float64(new[s]) - np.float64(labelling.data[p])
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
        excess[s] = total
    for p in sites:
        position[p] = -1
    return excess, neighbour, link
