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
from rangeseg_ros.core.threads import halves, strips

# Cells of the octahedral map (Meyer et al., "On floating-point normal vectors", EGSR 2010) along
# each axis: normals of a cell count as its centre, within two degrees.
_CELLS = 128
# Degrees in a unit of the data costs: 180 degrees at every pixel of a tile fit in 16 bits.
UNIT = np.float32(0.25)
# Pixels across the tiles.
TILE = 8
# What quarters may save and yet be one piece, as a share of the prior of the edges between them.
_KEEP = 0.2
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
    horizontal, vertical = horizontal.astype(np.float32), vertical.astype(np.float32)
    table, nearest = _table(directions.astype(np.float32).tobytes(), len(directions))
    cells = np.empty(normals.shape[:2], np.int32)
    strips(_cells, len(cells), normals, cells)
    image = np.full(cells.shape, -1, np.int32)
    tiles = -(-len(cells) // TILE)
    (upper, above), (lower, under) = halves(
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
    below[below >= 0] += len(upper)
    costs = np.concatenate([upper, lower])
    graph = adjacency(image, len(costs), horizontal, vertical, smoothness)
    return Pieces(image, costs, np.concatenate([above, under]), graph)


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


@njit(cache=True, nogil=True)
def _components(
    i0: int,
    j0: int,
    size: int,
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    found: NDArray[np.int32],
    first: int,
    stack: NDArray[np.int32],
) -> int:
    """Number the components of a tile from `first` in `found` (TILE, TILE); the next number.

    Pixels with `found` -2 are left out.
    """
    height, width = len(horizontal), vertical.shape[1]
    below, right = min(i0 + size, height), min(j0 + size, width)
    for i in range(i0, below):
        for j in range(j0, right):
            if found[i % TILE, j % TILE] != -1:
                continue
            found[i % TILE, j % TILE] = first
            stack[0] = i * width + j
            top = 1
            while top:
                top -= 1
                y, x = stack[top] // width, stack[top] % width
                for k in range(4):
                    b = y + (k == 1) - (k == 3)
                    a = x + (k == 0) - (k == 2)
                    if b < i0 or b >= below or a < j0 or a >= right:
                        continue
                    if found[b % TILE, a % TILE] != -1:
                        continue
                    u = horizontal[y, min(a, x)] if k % 2 == 0 else vertical[min(b, y), x]
                    if u > 0:
                        found[b % TILE, a % TILE] = first
                        stack[top] = b * width + a
                        top += 1
            first += 1
    return first


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
) -> tuple[NDArray[np.uint16], NDArray[np.int32]]:
    """Number the pieces of some rows of tiles from 0 in `image`, which is -1.

    Pixels without any edge or normal stay -1. Returns costs (n, K) and, for each piece, the label
    nearest to its mean normal (n,).
    """
    height, width = cells.shape
    labels = table.shape[1]
    result = np.empty((2048, labels), np.uint16)
    votes = np.empty(2048, np.int32)
    count = 0
    most = TILE * TILE
    # Components of the tile, of its quarters and of their quarters.
    found = np.empty((3, TILE, TILE), np.int32)
    number = np.empty(3, np.int32)
    total = np.empty((3, most, 3), np.float32)
    label = np.empty((3, most), np.int32)
    cost = np.empty((3, most), np.float32)
    spared = np.empty((3, most), np.float32)
    split = np.empty((3, most), np.bool_)
    parent = np.empty((3, most), np.int32)
    name = np.empty((3, most), np.int32)
    stack = np.empty(most, np.int32)
    for i0 in range(first * TILE, min(after * TILE, height), TILE):
        for j0 in range(0, width, TILE):
            below, right = min(i0 + TILE, height), min(j0 + TILE, width)
            linked = False
            for i in range(i0, below):
                for j in range(j0, right):
                    free = (
                        cells[i, j] >= 0
                        or (j + 1 < width and horizontal[i, j] > 0)
                        or (j > 0 and horizontal[i, j - 1] > 0)
                        or (i + 1 < height and vertical[i, j] > 0)
                        or (i > 0 and vertical[i - 1, j] > 0)
                    )
                    linked |= free
                    for level in range(3):
                        found[level, i - i0, j - j0] = -1 if free else -2
            if not linked:
                continue
            for level in range(3):
                size, n = TILE >> level, 0
                for i in range(i0, below, size):
                    for j in range(j0, right, size):
                        n = _components(i, j, size, horizontal, vertical, found[level], n, stack)
                number[level] = n
                total[level, :n], cost[level, :n], spared[level, :n] = 0, 0, 0
                split[level, :n], name[level, :n] = False, -1
            for i in range(i0, below):
                for j in range(j0, right):
                    a, b = i - i0, j - j0
                    if found[0, a, b] < 0:
                        continue
                    for level in range(3):
                        p = found[level, a, b]
                        if level:
                            parent[level, p] = found[level - 1, a, b]
                        if cells[i, j] >= 0:
                            for c in range(3):
                                total[level, p, c] += normals[i, j, c]
                    # Edges between the parts of a component.
                    for level in range(2):
                        p = found[level, a, b]
                        whole, part = found[level], found[level + 1]
                        if j + 1 < right and whole[a, b + 1] == p and part[a, b + 1] != part[a, b]:
                            spared[level, p] += np.float32(smoothness) * horizontal[i, j]
                        if i + 1 < below and whole[a + 1, b] == p and part[a + 1, b] != part[a, b]:
                            spared[level, p] += np.float32(smoothness) * vertical[i, j]
            for level in range(3):
                for p in range(number[level]):
                    x, y, z = total[level, p]
                    label[level, p] = nearest[max(_cell(x, y, z), 0)]
            for i in range(i0, below):
                for j in range(j0, right):
                    cell = cells[i, j]
                    if cell >= 0 and found[0, i - i0, j - j0] >= 0:
                        for level in range(3):
                            p = found[level, i - i0, j - j0]
                            cost[level, p] += np.float32(table[cell, label[level, p]])
            for level in range(1, -1, -1):
                limit = _SPLIT * spared[level]
                for p in range(number[level + 1]):
                    limit[parent[level + 1, p]] += cost[level + 1, p]
                    split[level, parent[level + 1, p]] |= split[level + 1, p]
                for p in range(number[level]):
                    split[level, p] |= cost[level, p] > limit[p]
            for i in range(i0, below):
                for j in range(j0, right):
                    a, b = i - i0, j - j0
                    if found[0, a, b] < 0:
                        continue
                    level = 0
                    while split[level, found[level, a, b]]:
                        level += 1
                    p = found[level, a, b]
                    if name[level, p] < 0:
                        if count == len(result):
                            result = np.concatenate((result, np.empty_like(result)))
                            votes = np.concatenate((votes, np.empty_like(votes)))
                        name[level, p] = count
                        result[count], votes[count] = 0, label[level, p]
                        count += 1
                    image[i, j] = name[level, p]
                    if cells[i, j] >= 0:
                        row, sums = table[cells[i, j]], result[name[level, p]]
                        for k in range(labels):
                            sums[k] += row[k]
    return result[:count], votes[:count]

