"""Expansions of one label near its boundaries, on a grid of sites: pixels or blocks of them.

Sites have numbers in raster order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.energy import mixed_angles, site_angle
from rangeseg_ros.core.moves import ROUNDING, minimum_cut

# Degrees per pixel that are much to save.
_ODD = 15.0


@dataclass(frozen=True, eq=False)
class Grid:
    """Sites, their normals and the prior.

    Attributes
    ----------
    normals : (n, 3, m) float32
        Unit normals of the m pixels of each site, NaN where undefined.
    links : (n, 4) float32
        Weights times the smoothness of the edges to the right, down, to the left and up, 0 at the
        border.
    width : int
        Sites in a row.
    """

    normals: NDArray[np.float32]
    links: NDArray[np.float32]
    width: int


class BandLabelling:
    """A labelling of a grid while label after label is expanded, each by a few sites.

    Parameters
    ----------
    labels : (n,) int32
        Labelling to start from.
    grid : Grid
    directions : (K, 3) float32
        What the labels stand for.

    Attributes
    ----------
    labels : (n,) int32
    data : (n,) float32
        Data cost of each site's label, degrees.
    """

    def __init__(
        self, labels: NDArray[np.int32], grid: Grid, directions: NDArray[np.float32]
    ) -> None:
        self.labels, self.grid, self._directions = labels, grid, directions
        self.data = mixed_angles(labels, grid.normals, directions)
        self._position = np.full(len(labels), -1, np.int32)

    def sweep(self, reach: int, wanted: NDArray[np.int32]) -> bool:
        """Expand every label once; whether that lowered the energy.

        Parameters
        ----------
        reach : int
            Sites from the boundary of a label that may switch to it.
        wanted : (n,) int32
            A label worth trying at a site that is not at its boundary, -1 for none.
        """
        grid, count = self.grid, len(self._directions)
        start, fronts = _fronts(self.labels, wanted, grid.links, grid.width, count)
        helped = False
        for alpha in np.flatnonzero(np.diff(start)).tolist():
            helped |= self._expand(alpha, fronts[start[alpha] : start[alpha + 1]], reach)
        return helped

    def _expand(self, alpha: int, front: NDArray[np.int32], reach: int) -> bool:
        grid = self.grid
        sites, new = _band(
            alpha,
            front,
            reach,
            grid.normals,
            self._directions[alpha],
            self.labels,
            self.data,
            grid.links,
            grid.width,
            self._position,
        )
        excess, first, second, link = _expansion(
            alpha,
            sites,
            new,
            self.labels,
            self.data,
            grid.links,
            grid.width,
            self._position,
        )
        if not len(excess):
            return False
        chosen = minimum_cut(excess, first, second, link)
        return _accept(
            alpha, chosen, sites, excess, new, first, second, link, self.labels, self.data
        )


@njit(cache=True)
def _fronts(
    labels: NDArray[np.int32],
    wanted: NDArray[np.int32],
    links: NDArray[np.float32],
    width: int,
    count: int,
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Sites beside each label's regions or that want it: label k's from start[k] to start[k + 1].

    By counting first and filling in then.
    """
    start = np.zeros(count + 2, np.int64)
    fronts = np.empty(0, np.int32)
    for filling in range(2):
        for p in range(len(labels)):
            here = labels[p]
            for k in range(2):
                q, u = p + (1 if k == 0 else width), links[p, k]
                if u > 0 and labels[q] != here:
                    there = labels[q]
                    if filling:
                        fronts[start[here + 1]] = q
                        start[here + 1] += 1
                        fronts[start[there + 1]] = p
                        start[there + 1] += 1
                    else:
                        start[here + 2] += 1
                        start[there + 2] += 1
            label = wanted[p]
            if label >= 0 and label != here:
                if filling:
                    fronts[start[label + 1]] = p
                    start[label + 1] += 1
                else:
                    start[label + 2] += 1
        if not filling:
            start = np.cumsum(start)
            fronts = np.empty(start[count + 1], np.int32)
    return start[: count + 1], fronts


@njit(cache=True)
def _band(
    alpha: int,
    front: NDArray[np.int32],
    reach: int,
    normals: NDArray[np.float32],
    direction: NDArray[np.float32],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
    links: NDArray[np.float32],
    width: int,
    position: NDArray[np.int32],
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Sites of other labels within `reach` steps of a front, and what the label costs them.

    Sets their `position`, which is -1 everywhere else.
    """
    offsets = np.array([1, width, -1, -width])
    a, b, c = direction[0], direction[1], direction[2]
    odd = np.float32(_ODD * normals.shape[2])
    sites = np.empty(max(64, 4 * len(front)), np.int32)
    new = np.empty(len(sites), np.float32)
    # Twice the steps: a site without a normal is half a step, as it costs no label anything, and
    # one that saves much by the label none.
    steps = np.empty(len(sites), np.int32)
    count = 0
    for p in front:
        if labels[p] != alpha and position[p] < 0:
            position[p] = count
            sites[count] = p
            new[count] = site_angle(normals[p], a, b, c)
            steps[count] = 2
            count += 1
    done = 0
    while done < count:
        p, far = sites[done], steps[done]
        done += 1
        if far >= 2 * reach:
            continue
        for k in range(4):
            q, u = p + offsets[k], links[p, k]
            if u > 0 and labels[q] != alpha and position[q] < 0:
                cost = site_angle(normals[q], a, b, c)
                step = 0 if data[q] - cost > odd else 1 if data[q] == 0 else 2
                if count == len(sites):
                    sites = np.concatenate((sites, np.empty_like(sites)))
                    new = np.concatenate((new, np.empty_like(new)))
                    steps = np.concatenate((steps, np.empty_like(steps)))
                position[q] = count
                sites[count] = q
                new[count] = cost
                steps[count] = far + step
                count += 1
    return sites[:count], new[:count]


@njit(cache=True)
def _expansion(
    alpha: int,
    sites: NDArray[np.int32],
    new: NDArray[np.float32],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
    links: NDArray[np.float32],
    width: int,
    position: NDArray[np.int32],
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """The binary problem of an expansion, in the terms of `moves`; empty if nothing can gain.

    `new` is the data cost of the label; `position` becomes -1 again.
    """
    offsets = np.array([1, width, -1, -width])
    count = len(sites)
    excess = np.empty(count)
    first = np.empty(2 * count, np.int32)
    second = np.empty(2 * count, np.int32)
    link = np.empty(2 * count)
    edges = 0
    gain = False
    for s in range(count):
        p = sites[s]
        here = labels[p]
        total = np.float64(new[s]) - np.float64(data[p])
        for k in range(4):
            q, u = p + offsets[k], links[p, k]
            if u == 0:
                continue
            w = np.float64(u)
            there = labels[q]
            if position[q] >= 0:
                if here != there:
                    w /= 2
                    total -= w
                if k < 2:
                    first[edges], second[edges], link[edges] = s, position[q], w
                    edges += 1
            elif there == alpha:
                total -= w
            elif there == here:
                total += w
        if total < 0:
            gain = True
        excess[s] = total
    for s in range(count):
        position[sites[s]] = -1
    if not gain:
        count = edges = 0
    return excess[:count], first[:edges], second[:edges], link[:edges]


@njit(cache=True)
def _accept(
    alpha: int,
    chosen: NDArray[np.bool_],
    sites: NDArray[np.int32],
    excess: NDArray[np.float64],
    new: NDArray[np.float32],
    first: NDArray[np.int32],
    second: NDArray[np.int32],
    link: NDArray[np.float64],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
) -> bool:
    """Give the chosen sites the label if that lowers the energy; whether it does."""
    value = 0.0
    for s in range(len(sites)):
        if chosen[s]:
            value += excess[s]
    for e in range(len(first)):
        if chosen[first[e]] != chosen[second[e]]:
            value += link[e]
    if value >= -ROUNDING:
        return False
    for s in range(len(sites)):
        if chosen[s]:
            labels[sites[s]] = alpha
            data[sites[s]] = new[s]
    return True
