"""Fast minimiser: few labels, blocks of pixels, then a band around the label boundaries."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.energy import angular_cost
from rangeseg_ros.core.moves import Graph, Labelling

BLOCK = 8
MIN_VOTES = 3


def minimise(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
    cycles: int,
    moves: str = 'expansion',
) -> NDArray[np.intp]:
    """Labelling of low energy, eq. 5.3 with the data cost of `angular_cost`.

    Blocks of 8 x 8 pixels vote for the directions worth trying. The energy of labellings that
    are constant on blocks (data costs summed over the block, weights over its borders) is
    minimised with these; then the pixels of blocks beside a label boundary are freed and the
    energy at full resolution minimised with the labels in use, the other pixels held.

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
        At most so many rounds of moves on either level.
    moves : {'expansion', 'swap'}

    Returns
    -------
    (H, W) intp
        Index into `directions`.
    """
    candidates = _voted(normals, directions)
    unary = angular_cost(normals, directions[candidates])
    coarse = _coarse_labels(unary, horizontal, vertical, smoothness, cycles, moves)
    used, coarse = np.unique(coarse, return_inverse=True)
    labels = _fine_labels(
        unary[used],
        coarse.reshape(-(-unary.shape[1] // BLOCK), -1),
        horizontal,
        vertical,
        smoothness,
        cycles,
        moves,
    )
    return candidates[used[labels]]


def _voted(normals: NDArray[np.float32], directions: NDArray[np.floating]) -> NDArray[np.intp]:
    """Directions nearest to the mean normal of some block."""
    total = _block_sum(np.nan_to_num(np.moveaxis(normals, 2, 0)))
    nearest = np.argmax(directions.astype(np.float32) @ total.reshape(3, -1), axis=0)
    nearest = nearest[np.abs(total).reshape(3, -1).sum(axis=0) > 0]
    votes = np.bincount(nearest, minlength=len(directions))
    return np.flatnonzero(votes >= min(MIN_VOTES, votes.max()))


def _coarse_labels(
    unary: NDArray[np.float32],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
    cycles: int,
    moves: str,
) -> NDArray[np.intp]:
    """Label per block, (h, w)."""
    costs = _block_sum(unary)
    across = _block_sum(horizontal[None, :, BLOCK - 1 :: BLOCK], (BLOCK, 1))[0]
    down = _block_sum(vertical[None, BLOCK - 1 :: BLOCK], (1, BLOCK))[0]
    shape = costs.shape[1:]
    graph = Graph.of_grid(across, down, smoothness)
    costs = costs.reshape(len(costs), -1)
    labelling = Labelling(graph, costs, costs.argmin(axis=0))
    labelling.minimise(cycles, moves)
    return labelling.labels.reshape(shape)


def _fine_labels(
    unary: NDArray[np.float32],
    coarse: NDArray[np.intp],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
    cycles: int,
    moves: str,
) -> NDArray[np.intp]:
    """Label per pixel, (H, W): those of blocks beside a label boundary are found anew."""
    shape = unary.shape[1:]
    block = coarse.astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    beside = cv2.dilate(block, kernel) != cv2.erode(block, kernel)
    labels, band = (
        np.repeat(np.repeat(a, BLOCK, 0), BLOCK, 1)[: shape[0], : shape[1]]
        for a in (coarse, beside)
    )
    costs = unary[:, band]
    index = np.cumsum(band.ravel()).reshape(shape) - 1
    for edge, inside, outside in _both_ways(horizontal, vertical):
        # A neighbour that is held costs every label but its own.
        rim = (edge > 0) & band[inside] & ~band[outside]
        site, weight = index[inside][rim], smoothness * edge[rim]
        np.add.at(costs, (slice(None), site), weight)
        np.add.at(costs, (labels[outside][rim], site), -weight)
    graph = Graph.of_grid(horizontal, vertical, smoothness, band)
    labelling = Labelling(graph, costs, labels[band])
    labelling.minimise(cycles, moves)
    labels = labels.copy()
    labels[band] = labelling.labels
    return labels


def _block_sum(stack: NDArray, size: tuple[int, int] = (BLOCK, BLOCK)) -> NDArray:
    """Sums over the blocks of each image of a stack (K, H, W); the last blocks may be smaller."""
    rows = np.add.reduceat(stack, np.arange(0, stack.shape[1], size[0]), axis=1)
    return np.add.reduceat(rows, np.arange(0, stack.shape[2], size[1]), axis=2)


def _both_ways(
    horizontal: NDArray[np.floating], vertical: NDArray[np.floating]
) -> list[tuple[NDArray[np.floating], tuple[slice, slice], tuple[slice, slice]]]:
    """Edge weights with the slices of the pixels at their two ends, in both orders."""
    every, head, tail = slice(None), slice(None, -1), slice(1, None)
    left, right, upper, lower = (every, head), (every, tail), (head, every), (tail, every)
    return [
        (horizontal, left, right),
        (horizontal, right, left),
        (vertical, upper, lower),
        (vertical, lower, upper),
    ]
