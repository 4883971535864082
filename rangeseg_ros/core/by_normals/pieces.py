"""Pieces of an image that are labelled as one: tiles cut along the jump edges.

A tile of 8 x 8 pixels falls into the components that its edges connect. Where one label suits a
component nearly as well as the best label of each quarter, the component is one piece; otherwise
its quarters are, each cut in components and, by the same rule, in quarters again. So jump edges
bound pieces to the pixel, and pieces are small where labels may change.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.angles import angle_table, find_cells
from rangeseg_ros.core.by_normals.piece_graph import Graph, adjacency
from rangeseg_ros.core.by_normals.tiles import (
    TILE,
    connect,
    empty_tile,
    label_components,
    load,
    mark_splits,
)
from rangeseg_ros.core.runtime.threads import map_halves, run_rows, submit
from rangeseg_ros.core.sensing.grid import Grid

# Borders of pieces run in steps: so much shorter are those that pixels draw in the end.
STAIRCASE_FACTOR = 0.95


class Pieces(NamedTuple):
    """Pieces, what each label costs them, and the edges between them.

    Attributes
    ----------
    image : (H, W) int32
        Piece of each pixel, -1 for pixels without any edge or normal.
    costs : (n, K) uint16
        Data cost of each label, summed over the pixels of each piece; `angles.UNIT` degrees.
    votes : (n,) int32
        Label nearest to the mean normal of each piece.
    graph : Graph
    """

    image: NDArray[np.int32]
    costs: NDArray[np.uint16]
    votes: NDArray[np.int32]
    graph: Graph


def pieces(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    grid: Grid,
    smoothness: float,
) -> Pieces:
    """Cut an image in pieces.

    Parameters
    ----------
    normals : (H, W, 3) float32
        NaN where undefined.
    directions : (K, 3) float
    grid : Grid
        (H, W).
    smoothness : float
        Lambda.
    """
    table, nearest = angle_table(directions.astype(np.float32).tobytes(), len(directions))
    cells = np.empty(normals.shape[:2], np.int32)
    run_rows(find_cells, len(cells), normals, cells)
    image = np.full(cells.shape, -1, np.int32)
    tiles = -(-len(cells) // TILE)
    above, under = map_halves(_cut, tiles, cells, normals, table, nearest, grid, smoothness, image)
    below = image[tiles // 2 * TILE :]
    np.add(below, len(above), out=below, where=below >= 0)
    votes = np.concatenate([above, under])
    graph = submit(adjacency, image, len(votes), grid, STAIRCASE_FACTOR * smoothness)
    costs = np.empty((len(votes), len(directions)), np.uint16)
    run_rows(_sum_up, tiles, image, cells, table, costs)
    return Pieces(image, costs, votes, graph.result())


@njit(cache=True, nogil=True)
def _cut(
    first: int,
    after: int,
    cells: NDArray[np.int32],
    normals: NDArray[np.float32],
    table: NDArray[np.uint16],
    nearest: NDArray[np.int32],
    grid: Grid,
    smoothness: float,
    image: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Number the pieces of some rows of tiles from 0 in `image`, which is -1.

    Pixels without any edge or normal stay -1. Returns the label (n,) nearest to the mean normal
    of each piece.
    """
    height, width = cells.shape
    most = TILE * TILE
    tile = empty_tile()
    votes = np.empty(height * width, np.int32)
    name = np.empty(most, np.int32)
    count = 0
    for i0 in range(first * TILE, min(after * TILE, height), TILE):
        for j0 in range(0, width, TILE):
            if not load(i0, j0, cells, grid, np.float32(smoothness), tile):
                continue
            connect(tile)
            label_components(i0, j0, normals, nearest, tile)
            mark_splits(table, tile)
            for a in range(most):
                if not tile.free[a]:
                    continue
                level = 0
                while tile.split[level, tile.whole[level, a]]:
                    level += 1
                p = tile.whole[level, a]
                if p == a:
                    name[p] = count
                    votes[count] = tile.label[level, p]
                    count += 1
                image[i0 + a // TILE, j0 + a % TILE] = name[p]
    return votes[:count].copy()


@njit(cache=True, nogil=True)
def _sum_up(
    first: int,
    after: int,
    image: NDArray[np.int32],
    cells: NDArray[np.int32],
    table: NDArray[np.uint16],
    costs: NDArray[np.uint16],
) -> None:
    """Costs of the pieces of some rows of tiles."""
    height, width = image.shape
    last = -1
    for i0 in range(first * TILE, min(after * TILE, height), TILE):
        for j0 in range(0, width, TILE):
            for i in range(i0, min(i0 + TILE, height)):
                for j in range(j0, min(j0 + TILE, width)):
                    p = image[i, j]
                    # Numbers rise from tile to tile and in a tile.
                    if p > last:
                        costs[p] = 0
                        last = p
                    if cells[i, j] >= 0 and p >= 0:
                        row, sums = table[cells[i, j]], costs[p]
                        for k in range(len(row)):
                            sums[k] += row[k]
