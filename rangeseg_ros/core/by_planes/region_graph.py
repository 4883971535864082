"""Which parts of an image touch, while they are joined to larger ones."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Ints, Mask
from rangeseg_ros.core.sensing.moments import COUNT, sum_by_label


class Contacts(NamedTuple):
    """Pairs of parts that touch, as chains of half-edges.

    Half-edge 2e of contact e leads from one part to the other, and 2e + 1 back. Parts touch few
    others: chains are shorter than the rows of a matrix, and the shorter to clear.
    """

    head: Ints  # (N,), first half-edge of each part, -1 for none
    link: Ints  # (2E,), the next one of the same part, -1 for none
    target: Ints  # (2E,), part that a half-edge leads to
    length: Floats  # (E,), of the common border, blocks; 0 where parts were joined
    place: Ints  # (N,), room for `absorb`, all -1


@njit(cache=True, nogil=True)
def find_contacts(part: Ints, right: Mask, below: Mask, count: int) -> Contacts:
    """Contacts between parts 1...count - 1 of blocks (rows, columns), 0 for none, see `Nodes`."""
    rows, columns = part.shape
    head = np.full(count, -1, np.int32)
    link = np.empty(4 * rows * columns, np.int32)
    target = np.empty(4 * rows * columns, np.int32)
    length = np.empty(2 * rows * columns)
    found = 0
    for i in range(rows):
        for j in range(columns):
            a = part[i, j]
            if a == 0:
                continue
            for u, v in ((i, j + 1), (i + 1, j)):
                if u == rows or v == columns or part[u, v] in (a, np.int32(0)):
                    continue
                if not (right[i, j] if u == i else below[i, j]):
                    continue
                b = part[u, v]
                h = head[a]
                while h >= 0 and target[h] != b:
                    h = link[h]
                if h < 0:
                    h = 2 * found
                    target[h], target[h + 1], length[found] = b, a, 0
                    link[h], link[h + 1] = head[a], head[b]
                    head[a], head[b] = h, h + 1
                    found += 1
                length[h // 2] += 1
    place = np.full(count, -1, np.int32)
    return Contacts(head, link[: 2 * found], target[: 2 * found], length[:found], place)


@njit(cache=True, nogil=True)
def absorb(contacts: Contacts, strips: Floats, apart: Floats, a: int, b: int) -> None:
    """Let part a take the contacts of part b over, in place; where both touch a third, add up.

    Added are the lengths, and the `strips` (2E, N) of the half-edges; of contacts that end `apart`
    (E,) becomes infinite.
    """
    head, link, target, length, place = contacts
    kept, h = -1, head[a]
    while h >= 0:
        following, c = link[h], target[h]
        if c == b:
            length[h // 2], apart[h // 2] = 0, np.inf
        elif length[h // 2] > 0:
            place[c] = h
            link[h], kept = kept, h
        h = following
    h = head[b]
    while h >= 0:
        following, e, c = link[h], h // 2, target[h]
        if length[e] > 0 and place[c] >= 0:
            other = place[c]
            for k in range(strips.shape[1]):
                strips[other, k] += strips[h, k]
                strips[other ^ 1, k] += strips[h ^ 1, k]
            length[other // 2] += length[e]
            length[e], apart[e] = 0, np.inf
        elif length[e] > 0:
            target[h ^ 1] = a
            link[h], kept = kept, h
        h = following
    head[a], head[b] = kept, -1
    h = kept
    while h >= 0:
        place[target[h]] = -1
        h = link[h]


@njit(cache=True)
def make_sets(count: int) -> Indices:
    """Parents of nodes that are roots: their own numbers. `np.arange` compiles for a second."""
    parent = np.empty(count, np.intp)
    for a in range(count):
        parent[a] = a
    return parent


@njit(cache=True)
def find_roots(parent: NDArray[Any]) -> NDArray[Any]:
    """Root (N,) of every node of a forest given by parents (N,); that of a root is itself."""
    root = np.empty_like(parent)
    for a in range(len(parent)):
        b = a
        while parent[b] != b:
            b = parent[b]
        root[a] = b
    return root


@njit(cache=True, nogil=True)
def renumbered(root: NDArray[np.integer], moments: Floats, least: float) -> tuple[Ints, Floats]:
    """Number the clusters of at least so many pixels 1...K, the rest 0; their moments."""
    pixels, number, count = np.zeros(len(root)), np.zeros(len(root), np.int32), 0
    for a in range(len(root)):
        pixels[root[a]] += moments[a, COUNT]
    for a in range(len(root)):
        if pixels[a] >= least:
            count += 1
            number[a] = count
    labels = number[root]
    return labels, sum_by_label(labels, moments, count + 1)
