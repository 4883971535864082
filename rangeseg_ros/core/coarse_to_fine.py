"""Fast minimiser: few labels, blocks of pixels, then bands around the label boundaries."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.energy import AngularCost
from rangeseg_ros.core.moves import Cost, Labelling

# Width of the blocks of each level, pixels; each divides the one before.
LEVELS = (8, 4, 1)


def minimise(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
    cycles: int,
) -> NDArray[np.intp]:
    """Labelling of low energy, eq. 5.3 with the data cost `AngularCost`, by alpha-expansion.

    Blocks vote for the directions worth trying. On the coarsest level the energy of labellings
    that are constant on blocks is minimised (data costs summed over the block, weights over its
    borders). Finer levels start from the labelling above, and a label is tried only where it may
    gain: around the boundaries of its regions, and where it suits a block far better than the
    block's label does.

    Parameters
    ----------
    normals : (H, W, 3) float32
        NaN where undefined.
    directions : (K, 3) float
    horizontal, vertical : (H, W-1), (H-1, W) float
        Neighbourhood weights.
    smoothness : float
        Lambda.
    cycles : int
        At most so many rounds of moves on the coarsest level.

    Returns
    -------
    (H, W) intp
        Index into `directions`.
    """
    height, width = normals.shape[:2]
    # Whole blocks only: beyond the image nothing is measured and nothing connected.
    rows, columns = -height % LEVELS[0], -width % LEVELS[0]
    normals = np.pad(normals, ((0, rows), (0, columns), (0, 0)), constant_values=np.nan)
    horizontal = np.pad(horizontal, ((0, rows), (0, columns)))
    vertical = np.pad(vertical, ((0, rows), (0, columns)))

    candidates = _voted(normals, directions)
    cost = AngularCost(normals, directions[candidates])
    tables = _block_costs(cost, normals.shape[:2])
    labels = tables[LEVELS[0]].argmin(axis=0)
    above = None
    for size in LEVELS:
        table = tables.get(size)
        labelling = Labelling(
            labels if above is None else _enlarged(labels, above // size),
            cost if table is None else _lookup(table),
            *_block_weights(horizontal, vertical, size),
            smoothness,
        )
        if above is None:
            labelling.minimise(len(candidates), cycles)
        else:
            threshold = 2 * smoothness * size
            for label, blocks in _windows(labelling, labels, tables[above], threshold):
                labelling.expand(label, np.flatnonzero(_enlarged(blocks, above // size)))
        labels, above = labelling.image, size
    return candidates[labels[:height, :width]]


def _voted(normals: NDArray[np.float32], directions: NDArray[np.floating]) -> NDArray[np.intp]:
    """Directions nearest to the mean normal of some block, at least one."""
    total = _block_sum(np.nan_to_num(normals), LEVELS[0]).reshape(-1, 3)
    nearest = np.argmax(total @ directions.astype(np.float32).T, axis=1)
    voted = np.unique(nearest[total.any(axis=1)])
    return voted if voted.size else np.zeros(1, np.intp)


def _block_costs(cost: AngularCost, shape: tuple[int, int]) -> dict[int, NDArray[np.float32]]:
    """Data costs of all labels summed over the blocks, (K, h, w), for every level but the last."""
    tables = {
        size: np.empty((cost.count, shape[0] // size, shape[1] // size), np.float32)
        for size in LEVELS[:-1]
    }
    for label in range(cost.count):
        image, width = cost(label).reshape(shape), 1
        for size in reversed(LEVELS[:-1]):
            image, width = _block_sum(image, size // width), size
            tables[size][label] = image
    return tables


def _lookup(table: NDArray[np.float32]) -> Cost:
    """Data cost of blocks from their table (K, h, w)."""

    def cost(label: int, blocks: NDArray[np.intp] | None = None) -> NDArray[np.float32]:
        costs = table[label].ravel()
        return costs if blocks is None else costs.take(blocks)

    return cost


def _block_sum(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Sums over blocks of size x size pixels of an image (H, W) or (H, W, C)."""
    shape = image.shape[1] // size, image.shape[0] // size
    return cv2.resize(image, shape, interpolation=cv2.INTER_AREA) * np.float32(size * size)


def _block_weights(
    horizontal: NDArray[np.floating], vertical: NDArray[np.floating], size: int
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Weights between neighbouring blocks: sums over the edges that cross their border."""
    height, width = len(horizontal), vertical.shape[1]
    across = np.add.reduceat(horizontal[:, size - 1 :: size], np.arange(0, height, size), axis=0)
    down = np.add.reduceat(vertical[size - 1 :: size], np.arange(0, width, size), axis=1)
    return across, down


def _enlarged(blocks: NDArray, ratio: int) -> NDArray:
    """Image of which every pixel becomes ratio x ratio pixels."""
    return blocks.repeat(ratio, axis=0).repeat(ratio, axis=1)


def _windows(
    labelling: Labelling,
    above: NDArray[np.integer],
    table: NDArray[np.float32],
    threshold: float,
) -> Iterator[tuple[int, NDArray[np.bool_]]]:
    """Labels with the blocks where they may lower the energy of the next finer level.

    Parameters
    ----------
    labelling : Labelling
        Of the finer level.
    above : (h, w) int
        Labelling of the blocks.
    table : (K, h, w) float32
        Data costs of the blocks.
    threshold : float
        What the sites of a block that suit a label better must save together.

    Yields
    ------
    label : int
    blocks : (h, w) bool
        At the boundaries of the label's regions, and wherever it would save more than the
        threshold, a block around included.
    """
    kernel = np.ones((3, 3), np.uint8)
    drawn = above.astype(np.float32)
    boundary = cv2.dilate(drawn, kernel) != cv2.erode(drawn, kernel)
    saved = np.take_along_axis(table, above[None], 0)[0] - table.min(axis=0)
    best = table.argmin(axis=0)[saved > threshold]
    ratio = len(labelling.image) // len(above)
    for label in np.unique(np.append(above, best)):
        around = cv2.dilate((above == label).astype(np.uint8), kernel) > 0
        gain = np.maximum(labelling.data - labelling.cost(int(label)), 0)
        suited = _block_sum(gain.reshape(labelling.image.shape), ratio) > threshold
        yield int(label), (around & boundary) | (cv2.dilate(suited.astype(np.uint8), kernel) > 0)
