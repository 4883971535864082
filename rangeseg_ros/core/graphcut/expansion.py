"""Expansion of one label by the sites around it: thesis 4.8 where the outcome is in question.

Sites are pixels, numbered in raster order. A site whose data speak louder than all of its
neighbours together is decided without a cut, and what it decides often decides its neighbours:
partial optimality, exact, and most of the band. The rest is a minimum cut (`moves`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut.cut import minimum_cut

Sites = tuple[NDArray[np.int64], NDArray[np.int32]]
"""Of each label: start (K + 1,) and sites (N,), label k's from start[k] to start[k + 1]."""


@njit(cache=True)
def fronts(labels: NDArray[np.int32], links: NDArray[np.float32], width: int, count: int) -> Sites:
    """Sites across an edge from each label's own.

    Parameters
    ----------
    labels : (n,) int32
    links : (2, n) float32
    width : int
        Sites in a row.
    count : int
        Number of labels.
    """
    beside, sites = np.empty(4 * len(labels), np.int32), np.empty(4 * len(labels), np.int32)
    found = 0
    for p in range(len(labels)):
        here = labels[p]
        for k in range(2):
            q = p + (1 if k == 0 else width)
            if q < len(labels) and labels[q] != here and links[k, p] > 0:
                beside[found], sites[found] = here, q
                beside[found + 1], sites[found + 1] = labels[q], p
                found += 2
    return grouped(beside[:found], sites[:found], count)


@njit(cache=True, nogil=True)
def grouped(labels: NDArray[np.int32], sites: NDArray[np.int32], count: int) -> Sites:
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


@njit(cache=True)
def band(
    alpha: int,
    front: NDArray[np.int32],
    reach: int,
    labels: NDArray[np.int32],
    links: NDArray[np.float32],
    width: int,
    position: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Sites of other labels within `reach` edges of a label.

    Parameters
    ----------
    alpha : int
    front : (m,) int32
        Sites next to those of the label.
    reach : int
    labels : (n,) int32
    links : (2, n) float32
    width : int
    position : (n,) int32
        -1; receives the place of each site in the result.

    Returns
    -------
    (s,) int32
    """
    offsets = np.array([1, width, -1, -width])
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
                linked = links[k % 2, min(p, q)] > 0
                if linked and labels[q] != alpha and position[q] < 0:
                    if count == len(sites):
                        sites = np.concatenate((sites, np.empty_like(sites)))
                    position[q] = count
                    sites[count] = q
                    count += 1
    return sites[:count]


class Choice(NamedTuple):
    """The binary problem of an expansion, as far as it could be decided without a cut.

    Attributes
    ----------
    sites : (s,) int32
        Those that may switch to the label.
    new : (s,) float32
        Data cost of the label there.
    switch : (s,) bool
        Whether the decided ones switch.
    value : float
        Change of the energy by the decided ones.
    open : (m,) int32
        Which of the sites are not decided.
    excess : (m,) float64
        What switching costs each of these more than staying.
    first, second : (e,) int32
        Ends of the edges between open sites, as places in `open`.
    link : (e,) float64
        Costs of cutting these.
    """

    sites: NDArray[np.int32]
    new: NDArray[np.float32]
    switch: NDArray[np.bool_]
    value: float
    open: NDArray[np.int32]
    excess: NDArray[np.float64]
    first: NDArray[np.int32]
    second: NDArray[np.int32]
    link: NDArray[np.float64]

    def make(
        self, alpha: int, labels: NDArray[np.int32], data: NDArray[np.float32], least: float
    ) -> bool:
        """Give label `alpha` to the best set of sites; in place. Whether that lowered the energy.

        Parameters
        ----------
        alpha : int
        labels, data : (n,) int32, (n,) float32
            Labelling and its data costs.
        least : float
            An improvement of no more than this is rounding.
        """
        value = self.value
        if len(self.open):
            chosen = minimum_cut(self.excess, self.first, self.second, self.link)
            self.switch[self.open] = chosen
            value += self.excess[chosen].sum()
            value += self.link[chosen[self.first] != chosen[self.second]].sum()
        if value >= -least:
            return False
        switched = self.sites[self.switch]
        labels[switched] = alpha
        data[switched] = self.new[self.switch]
        return True


@njit(cache=True)
def choice(
    alpha: int,
    sites: NDArray[np.int32],
    new: NDArray[np.float32],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
    links: NDArray[np.float32],
    width: int,
    position: NDArray[np.int32],
) -> Choice:
    """Decide the sites that can be decided without a cut.

    Parameters
    ----------
    alpha : int
    sites : (s,) int32
        Those that may switch, none of which has the label.
    new : (s,) float32
        Data cost of the label there.
    labels, data : (n,) int32, (n,) float32
        Labelling and its data costs.
    links : (2, n) float32
    width : int
    position : (n,) int32
        Place of each site in `sites`, -1 elsewhere; becomes -1 again.
    """
    offsets = np.array([1, width, -1, -width])
    count = len(sites)
    excess = np.empty(count)
    link = np.zeros((count, 4))
    # Weights of the edges to open sites.
    swing = np.zeros(count)
    beside = np.full((count, 4), -1, np.int32)
    for s in range(count):
        p = sites[s]
        here = labels[p]
        total = np.float64(new[s]) - np.float64(data[p])
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
                beside[s, k], link[s, k] = t, u
                swing[s] += u
            elif there == alpha:
                total -= u
            elif there == here:
                total += u
        excess[s] = total
    switch = np.zeros(count, np.bool_)
    is_open = np.ones(count, np.bool_)
    waiting = np.empty(count, np.int32)
    last = 0
    for s in range(count):
        position[sites[s]] = -1
        if excess[s] >= swing[s] or excess[s] < -swing[s]:
            waiting[last] = s
            is_open[s] = False
            last += 1
    value = 0.0
    done = 0
    while done < last:
        s = waiting[done]
        done += 1
        switch[s] = excess[s] < 0
        if switch[s]:
            value += excess[s]
        for k in range(4):
            t, u = beside[s, k], link[s, k]
            if t < 0:
                continue
            beside[t, (k + 2) % 4] = -1
            swing[t] -= u
            if switch[s]:
                value += u
                excess[t] -= u
            else:
                excess[t] += u
            if is_open[t] and (excess[t] >= swing[t] or excess[t] < -swing[t]):
                waiting[last] = t
                is_open[t] = False
                last += 1
    number = np.cumsum(is_open) - 1
    rest = np.flatnonzero(is_open).astype(np.int32)
    ends = np.empty((2, 2 * len(rest)), np.int32)
    cut = np.empty(2 * len(rest))
    edges = 0
    for a in range(len(rest)):
        s = rest[a]
        for k in range(2):
            if beside[s, k] >= 0:
                ends[0, edges], ends[1, edges] = a, number[beside[s, k]]
                cut[edges] = link[s, k]
                edges += 1
    first, second, cut = ends[0, :edges], ends[1, :edges], cut[:edges]
    return Choice(sites, new, switch, value, rest, excess[rest], first, second, cut)
