"""Graph of the pieces of an image: which ones adjoin, and what their borders weigh."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.grid import Grid


class Graph(NamedTuple):
    """Edges between pieces, each listed from both ends.

    Attributes
    ----------
    start : (n + 1,) int32
        Neighbours of piece p are those from start[p] to start[p + 1].
    neighbours : (m,) int32
    links : (m,) float32
        Weights of the edges to each neighbour times the smoothness.
    """

    start: NDArray[np.int32]
    neighbours: NDArray[np.int32]
    links: NDArray[np.float32]


def adjacency(image: NDArray[np.int32], count: int, grid: Grid, smoothness: float) -> Graph:
    """Graph of pieces.

    Parameters
    ----------
    image : (H, W) int32
        Piece of each pixel, below `count`; -1 for pixels without any edge.
    count : int
    grid : Grid
        (H, W).
    smoothness : float
        Lambda.
    """
    return Graph(*_adjacency(image, count, grid, smoothness))


@njit(cache=True, nogil=True)
def _adjacency(
    image: NDArray[np.int32], count: int, grid: Grid, smoothness: float
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Fields of the `Graph`."""
    height, width = image.shape
    room = np.zeros(count + 1, np.int32)
    for filling in range(2):
        if filling:
            room = np.cumsum(room).astype(np.int32)
            neighbours = np.empty(room[count], np.int32)
            links = np.empty(room[count], np.float32)
            used = room[:-1].copy()
        for i in range(height):
            for j in range(width):
                for k in range(2):
                    if (j + 1 == width) if k == 0 else (i + 1 == height):
                        continue
                    u = grid.right[i, j] if k == 0 else grid.below[i, j]
                    p = image[i, j]
                    q = image[i, j + 1] if k == 0 else image[i + 1, j]
                    if p == q or not u > 0:
                        continue
                    if not filling:
                        room[p + 1] += 1
                        room[q + 1] += 1
                        continue
                    for _ in range(2):
                        e = room[p]
                        while e < used[p] and neighbours[e] != q:
                            e += 1
                        if e == used[p]:
                            neighbours[e], links[e] = q, 0
                            used[p] += 1
                        links[e] += np.float32(smoothness) * u
                        p, q = q, p
    start = np.zeros(count + 1, np.int32)
    for p in range(count):
        n = used[p] - room[p]
        start[p + 1] = start[p] + n
        for e in range(n):
            neighbours[start[p] + e] = neighbours[room[p] + e]
            links[start[p] + e] = links[room[p] + e]
    return start, neighbours[: start[count]].copy(), links[: start[count]].copy()
