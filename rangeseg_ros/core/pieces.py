"""Pieces of an image that are labelled as one: tiles cut along the jump edges.

A tile of 8 x 8 pixels falls into the components that its edges connect. Where one label suits a
component nearly as well as the best label of each quarter, the component is one piece; otherwise
its quarters are, each cut in components and, by the same rule, in quarters again. So jump edges
bound pieces to the pixel, and pieces are small where labels may change.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.piece_graph import Graph, adjacency
from rangeseg_ros.core.threads import aside, halves, strips

# Cells of the octahedral map (Meyer et al., "On floating-point normal vectors", EGSR 2010) along
# each axis: normals of a cell count as its centre, within two degrees.
_CELLS = 128
# Degrees in a unit of the data costs: 180 degrees at every pixel of a tile fit in 16 bits.
UNIT = np.float32(0.25)
# Pixels across the tiles.
TILE = 8
# What quarters may save and yet be one piece, as a share of the prior of the edges between them.
_KEEP = 0.18
# Borders of pieces run in steps: so much shorter are those that pixels draw in the end.
SHORTER = 0.95
_SPLIT = np.float32(_KEEP / UNIT)


class Pieces(NamedTuple):
    """Pieces, what each label costs them, and the edges between them.

    Attributes
    ----------
    image : (H, W) int32
        Piece of each pixel, -1 for pixels without any edge or normal.
    costs : (n, K) uint16
        Data cost of each label, summed over the pixels of each piece; `UNIT` degrees.
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
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
) -> Pieces:
    """Cut an image in pieces.

    Parameters
    ----------
    normals : (H, W, 3) float32
        NaN where undefined.
    directions : (K, 3) float
    horizontal, vertical : (H, W-1), (H-1, W) float
        Neighbourhood weights.
    smoothness : float
        Lambda.
    """
    horizontal = horizontal.astype(np.float32, copy=False)
    vertical = vertical.astype(np.float32, copy=False)
    table, nearest = _table(directions.astype(np.float32).tobytes(), len(directions))
    cells = np.empty(normals.shape[:2], np.int32)
    strips(_cells, len(cells), normals, cells)
    image = np.full(cells.shape, -1, np.int32)
    tiles = -(-len(cells) // TILE)
    above, under = halves(
        _cut,
        tiles,
        cells,
        normals,
        table,
        nearest,
        horizontal,
        vertical,
        smoothness,
        image,
    )
    below = image[tiles // 2 * TILE :]
    np.add(below, len(above), out=below, where=below >= 0)
    votes = np.concatenate([above, under])
    graph = aside(adjacency, image, len(votes), horizontal, vertical, SHORTER * smoothness)
    costs = np.empty((len(votes), len(directions)), np.uint16)
    strips(_sum_up, tiles, image, cells, table, costs)
    return Pieces(image, costs, votes, graph.result())


@lru_cache(maxsize=4)
def _table(directions: bytes, count: int) -> tuple[NDArray[np.uint16], NDArray[np.int32]]:
    """Angles (cells, count) of the centres of the cells to directions; the nearest direction."""
    middle = (np.arange(_CELLS) + 0.5) * (2 / _CELLS) - 1
    u, v = (a.ravel() for a in np.meshgrid(middle, middle, indexing='ij'))
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    centres = np.stack([u - np.copysign(fold, u), v - np.copysign(fold, v), z], 1)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    vectors = np.frombuffer(directions, np.float32).reshape(count, 3)
    angles = np.degrees(np.arccos(np.clip(centres @ vectors.T, -1, 1)))
    return np.rint(angles / UNIT).astype(np.uint16), angles.argmin(axis=1).astype(np.int32)


@njit(cache=True, nogil=True)
def _cell(x: np.float32, y: np.float32, z: np.float32) -> int:
    """Cell of the octahedral map that a direction lies in, -1 for none."""
    length = abs(x) + abs(y) + abs(z)
    if not length > 0:
        return -1
    u, v = x / length, y / length
    if z < 0:
        u, v = (
            np.float32(math.copysign(np.float32(1) - abs(v), u)),
            np.float32(math.copysign(np.float32(1) - abs(u), v)),
        )
    a = min(max(int((u + np.float32(1)) * np.float32(_CELLS / 2)), 0), _CELLS - 1)
    b = min(max(int((v + np.float32(1)) * np.float32(_CELLS / 2)), 0), _CELLS - 1)
    return a * _CELLS + b


@njit(cache=True, nogil=True)
def _cells(first: int, after: int, normals: NDArray[np.float32], cells: NDArray[np.int32]) -> None:
    """Cell that each normal of some rows lies in, -1 for NaN."""
    for i in range(first, after):
        for j in range(cells.shape[1]):
            cells[i, j] = _cell(normals[i, j, 0], normals[i, j, 1], normals[i, j, 2])


class _Tile(NamedTuple):
    """A tile, its pixels in raster order and its components at three levels.

    A component is named by its first pixel: [level, p] tells of the component of the whole tile
    (level 0), of a quarter (1) or of a quarter's quarter (2) that begins at pixel p.

    Attributes
    ----------
    cell : (64,) int32
        -1 for pixels without normal.
    free : (64,) bool
        Whether there is an edge or a normal.
    right, below : (64,) float32
        Links to the next pixel of the tile in the row and in the column.
    whole : (3, 64) int32
        First pixel of the component that each pixel is in.
    first : (3, 64) int32
        Names of the components of each level.
    number : (3,) int32
        How many they are.
    normal : (3, 64, 3) float32
        Sum over the component.
    label : (3, 64) int32
        Nearest to that.
    cost, parts : (3, 64) int32
        Of the label, and of the labels of the parts at the next level, in `UNIT`.
    spared : (3, 64) float32
        Links between the parts at the next level.
    split : (3, 64) bool
        Whether the parts have labels of their own.
    """

    cell: NDArray[np.int32]
    free: NDArray[np.bool_]
    right: NDArray[np.float32]
    below: NDArray[np.float32]
    whole: NDArray[np.int32]
    first: NDArray[np.int32]
    number: NDArray[np.int32]
    normal: NDArray[np.float32]
    label: NDArray[np.int32]
    cost: NDArray[np.int32]
    parts: NDArray[np.int32]
    spared: NDArray[np.float32]
    split: NDArray[np.bool_]


@njit(cache=True, nogil=True)
def _load(
    i0: int,
    j0: int,
    cells: NDArray[np.int32],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: np.float32,
    tile: _Tile,
) -> bool:
    """Fill in cells, links and what is free; whether anything is."""
    height, width = cells.shape
    cell, free, right, below = tile.cell, tile.free, tile.right, tile.below
    linked = False
    for a in range(TILE * TILE):
        i, j = i0 + a // TILE, j0 + a % TILE
        cell[a], free[a], right[a], below[a] = -1, False, 0, 0
        if i >= height or j >= width:
            continue
        cell[a] = cells[i, j]
        u = horizontal[i, j] if j + 1 < width else np.float32(0)
        v = vertical[i, j] if i + 1 < height else np.float32(0)
        if (
            cells[i, j] >= 0
            or u > 0
            or v > 0
            or (j > 0 and horizontal[i, j - 1] > 0)
            or (i > 0 and vertical[i - 1, j] > 0)
        ):
            free[a] = linked = True
        if a % TILE < TILE - 1:
            right[a] = smoothness * u
        if a // TILE < TILE - 1:
            below[a] = smoothness * v
    return linked


@njit(cache=True, nogil=True)
def _connect(tile: _Tile) -> None:
    """Find the components of all levels, the smallest first, and the links between their parts.

    A union-find whose parents come before their children.
    """
    free, right, below = tile.free, tile.right, tile.below
    whole, first, spared = tile.whole, tile.first, tile.spared
    for level in range(2, -1, -1):
        for a in range(TILE * TILE):
            whole[level, a] = a if level == 2 else whole[level + 1, a]
            spared[level, a] = 0
        # Links between the halves of blocks of this size.
        size = TILE >> level
        for x in range(size // 2 - 1, TILE, size):
            for y in range(TILE):
                a, b = y * TILE + x, x * TILE + y
                if right[a] > 0:
                    _unite(whole, level, a, a + 1)
                if below[b] > 0:
                    _unite(whole, level, b, b + TILE)
        count = 0
        for a in range(TILE * TILE):
            whole[level, a] = whole[level, whole[level, a]]
            if whole[level, a] == a and free[a]:
                first[level, count] = a
                count += 1
        tile.number[level] = count
        for x in range(size // 2 - 1, TILE, size):
            for y in range(TILE):
                a, b = y * TILE + x, x * TILE + y
                spared[level, whole[level, a]] += right[a]
                spared[level, whole[level, b]] += below[b]


@njit(cache=True, nogil=True)
def _unite(parent: NDArray[np.int32], level: int, a: int, b: int) -> None:
    while parent[level, a] != a:
        a = parent[level, a]
    while parent[level, b] != b:
        b = parent[level, b]
    parent[level, max(a, b)] = min(a, b)


@njit(cache=True, nogil=True)
def _vote(
    i0: int,
    j0: int,
    normals: NDArray[np.float32],
    nearest: NDArray[np.int32],
    tile: _Tile,
) -> None:
    """Label of the mean normal of each component."""
    cell, whole, first, number = tile.cell, tile.whole, tile.first, tile.number
    total, label = tile.normal, tile.label
    for level in range(3):
        for s in range(number[level]):
            for c in range(3):
                total[level, first[level, s], c] = 0
    for a in range(TILE * TILE):
        if cell[a] >= 0:
            for c in range(3):
                total[2, whole[2, a], c] += normals[i0 + a // TILE, j0 + a % TILE, c]
    for level in range(2, -1, -1):
        for s in range(number[level]):
            p = first[level, s]
            found = _cell(total[level, p, 0], total[level, p, 1], total[level, p, 2])
            label[level, p] = nearest[max(found, 0)]
            if level:
                for c in range(3):
                    total[level - 1, whole[level - 1, p], c] += total[level, p, c]


@njit(cache=True, nogil=True)
def _judge(table: NDArray[np.uint16], tile: _Tile) -> None:
    """Tell which components fall into their parts."""
    cell, whole, first, number = tile.cell, tile.whole, tile.first, tile.number
    label, cost, parts, split = tile.label, tile.cost, tile.parts, tile.split
    for level in range(3):
        for s in range(number[level]):
            p = first[level, s]
            cost[level, p] = parts[level, p] = 0
            split[level, p] = False
    for a in range(TILE * TILE):
        if cell[a] >= 0:
            for level in range(3):
                p = whole[level, a]
                cost[level, p] += table[cell[a], label[level, p]]
    for level in range(1, -1, -1):
        for s in range(number[level + 1]):
            a = first[level + 1, s]
            p = whole[level, a]
            parts[level, p] += cost[level + 1, a]
            split[level, p] |= split[level + 1, a]
        for s in range(number[level]):
            p = first[level, s]
            more = cost[level, p] - parts[level, p]
            split[level, p] |= more > _SPLIT * tile.spared[level, p]


@njit(cache=True, nogil=True)
def _cut(
    first: int,
    after: int,
    cells: NDArray[np.int32],
    normals: NDArray[np.float32],
    table: NDArray[np.uint16],
    nearest: NDArray[np.int32],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
    image: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Number the pieces of some rows of tiles from 0 in `image`, which is -1.

    Pixels without any edge or normal stay -1. Returns the label (n,) nearest to the mean normal
    of each piece.
    """
    height, width = cells.shape
    most = TILE * TILE
    tile = _Tile(
        np.empty(most, np.int32),
        np.empty(most, np.bool_),
        np.empty(most, np.float32),
        np.empty(most, np.float32),
        np.empty((3, most), np.int32),
        np.empty((3, most), np.int32),
        np.empty(3, np.int32),
        np.empty((3, most, 3), np.float32),
        np.empty((3, most), np.int32),
        np.empty((3, most), np.int32),
        np.empty((3, most), np.int32),
        np.empty((3, most), np.float32),
        np.empty((3, most), np.bool_),
    )
    votes = np.empty(height * width, np.int32)
    name = np.empty(most, np.int32)
    count = 0
    for i0 in range(first * TILE, min(after * TILE, height), TILE):
        for j0 in range(0, width, TILE):
            if not _load(i0, j0, cells, horizontal, vertical, np.float32(smoothness), tile):
                continue
            _connect(tile)
            _vote(i0, j0, normals, nearest, tile)
            _judge(table, tile)
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
