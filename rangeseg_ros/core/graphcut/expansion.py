"""Alpha-expansion on the 4-connected grid (thesis 4.8), for both methods.

The energy is E(f) = sum_p D_p(f_p) + lambda sum_pq u_pq [f_p != f_q]. D_p is the data cost of each
method: `by_normals.labelling`, `by_planes.plane_energy`. The other sum is the Potts prior over the
grid, with the neighbourhood weights u of `Grid`. Sites, in raster order, are pixels or squares.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Ints, Mask, Singles
from rangeseg_ros.core.graphcut.cut import minimum_cut
from rangeseg_ros.core.sensing.grid import Grid

ROUNDING = 1e-3
"""A move must lower the energy by more than the rounding of its sums."""
# Of each label: start (K + 1,) and sites (N,), label k's from start[k] to start[k + 1].
Sites = tuple[NDArray[np.int64], Ints]


class GridLabelling(NamedTuple):
    """A labelling of n sites, in raster order, while expansions change it."""

    labels: Ints  # (n,)
    data: Singles  # (n,), data cost of each site's label
    links: Singles  # (2, n), see `link_costs`
    width: int  # sites in a row
    position: Ints  # (n,), scratch of the expansions: -1 between them

    @classmethod
    def of(cls, labels: Ints, data: Singles, links: Singles, width: int) -> GridLabelling:
        """Begin with these labels and data costs, which change in place."""
        return cls(labels, data, links, width, np.full(len(labels), -1, np.int32))


def energy(data: NDArray[np.floating], labels: NDArray[np.integer], links: Singles) -> float:
    """Value of E for labels (H, W) of data costs (H, W), with `link_costs` of the grid."""
    right, below = links.reshape(2, *labels.shape)
    border = right[:, :-1][labels[:, 1:] != labels[:, :-1]].sum(dtype=float)
    border += below[:-1][labels[1:] != labels[:-1]].sum(dtype=float)
    return float(data.sum(dtype=float) + border)


def link_costs(grid: Grid, smoothness: float) -> Singles:
    """Lambda u of every edge of a grid (H, W), in the order of the sites; lambda = `smoothness`.

    (2, H * W): of each pixel's edges to the right and down, 0 at the border. The edge between p
    and its neighbour q on side k (0 right, 1 down, 2 left, 3 up) is [k % 2, min(p, q)]; before the
    first pixel, where this counts from the end, is a border as well.
    """
    height, width = len(grid.right), grid.below.shape[1]
    result = np.empty((2, height, width), np.float32)
    result[0, :, -1] = result[1, -1] = 0
    np.multiply(grid.right, np.float32(smoothness), out=result[0, :, :-1], casting='same_kind')
    np.multiply(grid.below, np.float32(smoothness), out=result[1, :-1], casting='same_kind')
    return result.reshape(2, -1)


def minimise(labelling: GridLabelling, count: int, cost: Callable[[int, Ints], Singles]) -> None:
    """Expand each of `count` labels over all sites until none helps (listing 4.1); in place.

    `cost` gives the data costs (s,) of a label at sites (s,).
    """
    alpha = idle = 0
    while idle < count:
        sites = np.flatnonzero(labelling.labels != alpha).astype(np.int32)
        labelling.position[sites] = np.arange(len(sites))
        helped = expand(alpha, sites, cost(alpha, sites), labelling, ROUNDING)
        idle = 0 if helped else idle + 1
        alpha = (alpha + 1) % count


@njit(cache=True, nogil=True)
def expand(alpha: int, sites: Ints, new: Singles, labelling: GridLabelling, least: float) -> bool:
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
def change(switch: Mask, excess: Floats, neighbour: Ints, link: Floats) -> float:
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
    alpha: int, sites: Ints, new: Singles, labelling: GridLabelling
) -> tuple[Floats, Ints, Floats]:
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


@njit(cache=True, nogil=True)
def fronts(labelling: GridLabelling, count: int, rows: tuple[int, int]) -> Sites:
    """Sites in some rows that are across an edge from each of `count` labels' own."""
    labels, links, width, found = labelling.labels, labelling.links, labelling.width, 0
    first, after = rows[0] * width, rows[1] * width
    owners, sites = np.empty((2, 4 * (after - first)), np.int32)
    for p in range(max(first - width, 0), after):
        # The last pixel of a row has no link to the right.
        for k, q in enumerate((p + 1, p + width)):
            if q < len(labels) and labels[q] != labels[p] and links[k, p] > 0:
                if first <= q < after:
                    owners[found], sites[found] = labels[p], q
                    found += 1
                if p >= first:
                    owners[found], sites[found] = labels[q], p
                    found += 1
    return group_sites(owners[:found], sites[:found], count)


@njit(cache=True, nogil=True)
def group_sites(labels: Ints, sites: Ints, count: int) -> Sites:
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
    alpha: int, front: Ints, reach: int, labelling: GridLabelling, rows: tuple[int, int]
) -> Ints:
    """Sites of other labels, in some rows, within `reach` edges of a label.

    `front` (m,) are sites next to those of the label, one or more times; those of the label are
    left out. `labelling.position` receives the place of each site in the result (s,).
    """
    labels, links, position = labelling.labels, labelling.links, labelling.position
    offsets = np.array([1, labelling.width, -1, -labelling.width])
    first, after = rows[0] * labelling.width, rows[1] * labelling.width
    # Room for all within so many edges: an array that a loop makes anew is counted at every turn.
    sites = np.empty((2 * reach * (reach - 1) + 1) * len(front), np.int32)
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
                    position[q] = count
                    sites[count] = q
                    count += 1
    return sites[:count]


@njit(cache=True, nogil=True)
def beyond(alpha: int, sites: Ints, labelling: GridLabelling, rows: tuple[int, int]) -> Ints:
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
