"""A tile of an image: the components that its edges connect, and which fall into their parts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.angles import UNIT, cell_of
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.grid import Grid

TILE = 2 * BLOCK
"""Pixels across the tiles: they fall into quarters, blocks, and these into quarters again."""
# What quarters may save and yet be one piece, as a share of the prior of the edges between them.
_SPLIT_GAIN_SHARE = 0.18
_SPLIT_GAIN = np.float32(_SPLIT_GAIN_SHARE / UNIT)


class Tile(NamedTuple):
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
def empty_tile() -> Tile:
    """A tile to load."""
    most = TILE * TILE
    return Tile(
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


@njit(cache=True, nogil=True)
def load(
    i0: int,
    j0: int,
    cells: NDArray[np.int32],
    grid: Grid,
    smoothness: np.float32,
    tile: Tile,
) -> bool:
    """Fill in cells, links and what is free; whether anything is."""
    height, width = cells.shape
    horizontal, vertical = grid
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
def connect(tile: Tile) -> None:
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
def label_components(
    i0: int,
    j0: int,
    normals: NDArray[np.float32],
    nearest: NDArray[np.int32],
    tile: Tile,
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
            found = cell_of(total[level, p, 0], total[level, p, 1], total[level, p, 2])
            label[level, p] = nearest[max(found, 0)]
            if level:
                for c in range(3):
                    total[level - 1, whole[level - 1, p], c] += total[level, p, c]


@njit(cache=True, nogil=True)
def mark_splits(table: NDArray[np.uint16], tile: Tile) -> None:
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
            split[level, p] |= more > _SPLIT_GAIN * tile.spared[level, p]
