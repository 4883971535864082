"""Fast minimiser: blocks of pixels vote for few labels, then bands around the boundaries.

On the coarsest level the energy of labellings that are constant on blocks is minimised (data
costs summed over the block, weights over its borders). Finer levels start from the labelling
above and expand each label by a few blocks, in the end pixels, around the boundaries of its
regions, and where the normals of a block ask for a label far better than its own. On every
level regions then move to the direction that suits all of their normals.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.bands import BandLabelling, Grid
from rangeseg_ros.core.energy import angles
from rangeseg_ros.core.moves import ROUNDING
from rangeseg_ros.core.regions import connected_components

# Width of the blocks of each level, pixels, each a divisor of the one before; how many blocks a
# label may advance in a sweep; sweeps at most.
LEVELS = ((8, 8, 2), (4, 4, 1), (2, 3, 1), (1, 2, 1))
# Pixels across the tiles that ask for labels; degrees from which a pixel counts as odd; what the
# odd pixels of a tile must save together, edges.
_TILE, _ODD, _SAVING = 8, 20.0, 8.0
# Directions around the mean normal of a region that are tried for it, by about so many of its
# pixels.
_TRIED, _LARGE = 7, 3000


def minimise(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
) -> NDArray[np.intp]:
    """Labelling of low energy, eq. 5.3 with the angle to the normals as data cost (eq. 5.5).

    Parameters
    ----------
    normals : (H, W, 3) float32
        NaN where undefined.
    directions : (K, 3) float
    horizontal, vertical : (H, W-1), (H-1, W) float
        Neighbourhood weights.
    smoothness : float
        Lambda.

    Returns
    -------
    (H, W) intp
        Index into `directions`.
    """
    height, width = normals.shape[:2]
    # Whole blocks only: beyond the image nothing is measured and nothing connected.
    rows, columns = -height % LEVELS[0][0], -width % LEVELS[0][0]
    normals = np.pad(normals, ((0, rows), (0, columns), (0, 0)), constant_values=np.nan)
    horizontal = np.pad(horizontal, ((0, rows), (0, columns)))
    vertical = np.pad(vertical, ((0, rows), (0, columns)))
    labelled = directions.astype(np.float32)

    coarsest = LEVELS[0][0]
    image = _votes(_blocks(normals, coarsest), labelled).reshape(-1, normals.shape[1] // coarsest)
    for size, reach, sweeps in LEVELS:
        grid = Grid(
            _blocks(normals, size),
            _links(horizontal, vertical, size, smoothness),
            normals.shape[1] // size,
        )
        ratio = grid.width // image.shape[1]
        image = image.repeat(ratio, axis=0).repeat(ratio, axis=1)
        labelling = BandLabelling(image.ravel(), grid, labelled)
        wanted = _wanted(
            labelling.data,
            grid.normals,
            grid.width,
            labelled,
            _TILE // size,
            _ODD,
            _SAVING * smoothness,
        )
        for _ in range(sweeps):
            helped = labelling.sweep(reach, wanted)
            _turn(labelling, labelled, max(1, _LARGE // size**2))
            if not helped:
                break
        image = labelling.labels.reshape(image.shape)
    return image[:height, :width].astype(np.intp)


def _votes(normals: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int32]:
    """Direction nearest to the mean normal of each block (n,)."""
    return np.argmax(_sum(normals) @ directions.T, axis=1).astype(np.int32)


@njit(cache=True)
def _wanted(
    data: NDArray[np.float32],
    normals: NDArray[np.float32],
    width: int,
    directions: NDArray[np.float32],
    tile: int,
    odd: float,
    saving: float,
) -> NDArray[np.int32]:
    """Direction of the sites of a tile that their label suits badly, where all save much by it.

    -1 elsewhere.
    """
    pixels = normals.shape[2]
    wanted = np.full(len(data), -1, np.int32)
    sites = np.empty(tile * tile, np.int32)
    for i0 in range(0, len(data) // width, tile):
        for j0 in range(0, width, tile):
            count = 0
            x, y, z = np.float32(0), np.float32(0), np.float32(0)
            for i in range(i0, i0 + tile):
                for j in range(j0, j0 + tile):
                    p = i * width + j
                    if data[p] > odd * pixels:
                        sites[count] = p
                        count += 1
                        for k in range(pixels):
                            if normals[p, 0, k] == normals[p, 0, k]:
                                x += normals[p, 0, k]
                                y += normals[p, 1, k]
                                z += normals[p, 2, k]
            total = np.float32(0)
            for k in range(count):
                total += data[sites[k]]
            if total <= saving:
                continue
            best, most = 0, np.float32(-1e30)
            for d in range(len(directions)):
                along = x * directions[d, 0] + y * directions[d, 1] + z * directions[d, 2]
                if along > most:
                    best, most = d, along
            each = angles(sites[:count], normals, directions[best])
            saved = np.float32(0)
            for k in range(count):
                saved += max(data[sites[k]] - each[k], np.float32(0))
            if saved > saving:
                for k in range(count):
                    if data[sites[k]] > each[k]:
                        wanted[sites[k]] = best
    return wanted


@njit(cache=True)
def _blocks(normals: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Normals (H, W, 3) by blocks (n, 3, size * size)."""
    rows, columns = normals.shape[0] // size, normals.shape[1] // size
    blocks = np.empty((rows * columns, 3, size * size), np.float32)
    for i in range(rows * size):
        for j in range(columns * size):
            block = blocks[i // size * columns + j // size]
            for c in range(3):
                block[c, i % size * size + j % size] = normals[i, j, c]
    return blocks


@njit(cache=True)
def _sum(normals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums (n, 3) of the normals of each block."""
    total = np.zeros((len(normals), 3), np.float32)
    for p in range(len(normals)):
        for c in range(3):
            for k in range(normals.shape[2]):
                x = normals[p, c, k]
                if x == x:
                    total[p, c] += x
    return total


@njit(cache=True)
def _links(
    horizontal: NDArray[np.floating], vertical: NDArray[np.floating], size: int, smoothness: float
) -> NDArray[np.float32]:
    """Prior (n, 4) between each block and its neighbours: sums over their borders."""
    rows, columns = len(horizontal) // size, vertical.shape[1] // size
    links = np.zeros((rows * columns, 4), np.float32)
    for i in range(rows * size):
        for j in range(1, columns):
            p = i // size * columns + j
            links[p, 2] += smoothness * horizontal[i, j * size - 1]
            links[p - 1, 0] = links[p, 2]
    for i in range(1, rows):
        for j in range(columns * size):
            p = i * columns + j // size
            links[p, 3] += smoothness * vertical[i * size - 1, j]
            links[p - columns, 1] = links[p, 3]
    return links


def _turn(labelling: BandLabelling, directions: NDArray[np.float32], largest: int) -> None:
    """Give every region up to a size the direction that suits its normals best."""
    grid = labelling.grid
    shape = -1, grid.width
    regions = connected_components(
        labelling.labels.reshape(shape),
        grid.links[:, 0].reshape(shape)[:, :-1],
        grid.links[:, 1].reshape(shape)[:-1],
    )
    _turn_regions(
        regions.ravel(),
        labelling.labels,
        labelling.data,
        grid.normals,
        directions,
        1 - _TRIED / len(directions),
        largest,
    )


@njit(cache=True)
def _turn_regions(
    regions: NDArray[np.int32],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    cosine: float,
    largest: int,
) -> None:
    """In place; directions within the angle of the cosine to the mean normal are tried."""
    start = np.zeros(regions.max() + 2, np.int64)
    for p in range(len(regions)):
        start[regions[p] + 1] += 1
    start = np.cumsum(start)
    last = start[:-1].copy()
    order = np.empty(len(regions), np.int32)
    for p in range(len(regions)):
        order[last[regions[p]]] = p
        last[regions[p]] += 1
    for r in range(len(start) - 1):
        sites = order[start[r] : start[r + 1]]
        if len(sites) == 0:
            continue
        sample = sites[:: 1 + len(sites) // largest]
        x, y, z, cost = 0.0, 0.0, 0.0, 0.0
        for p in sample:
            cost += data[p]
            for k in range(normals.shape[2]):
                if normals[p, 0, k] == normals[p, 0, k]:
                    x += normals[p, 0, k]
                    y += normals[p, 1, k]
                    z += normals[p, 2, k]
        limit = cosine * np.sqrt(x * x + y * y + z * z)
        best = label = labels[sites[0]]
        for d in range(len(directions)):
            along = x * directions[d, 0] + y * directions[d, 1] + z * directions[d, 2]
            if d == label or along <= limit:
                continue
            total = 0.0
            for value in angles(sample, normals, directions[d]):
                total += value
            if total < cost - ROUNDING:
                best, cost = d, total
        if best != label:
            labels[sites], data[sites] = best, angles(sites, normals, directions[best])
