"""Sites of a grid that an expansion may change: those around each label.

Sites are pixels, numbered in raster order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

# Of each label: start (K + 1,) and sites (N,), label k's from start[k] to start[k + 1].
Sites = tuple[NDArray[np.int64], NDArray[np.int32]]


class GridLabelling(NamedTuple):
    """A labelling of n pixels, in raster order, while expansions change it."""

    labels: NDArray[np.int32]  # (n,)
    data: NDArray[np.float32]  # (n,), data cost of each pixel's label
    links: NDArray[np.float32]  # (2, n), see `energy.link_costs`
    width: int  # pixels in a row
    position: NDArray[np.int32]  # (n,), scratch of the expansions: -1 between them

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
