"""Fast minimiser: pieces of the image first, then pixels around the boundaries.

The energy of labellings that are constant on pieces is minimised: regions of pieces take labels
as wholes, then the labels in use are expanded. Last, labels are expanded by some pixels about
their boundaries, and give way to those beside them where these suit better.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.octahedral import UNIT
from rangeseg_ros.core.by_normals.piece_expansion import expand
from rangeseg_ros.core.by_normals.pieces import Pieces, pieces
from rangeseg_ros.core.by_normals.region_moves import settle, turn
from rangeseg_ros.core.graphcut.energy import angles, degrees, mixed_angles, site_angle
from rangeseg_ros.core.graphcut.expansion import Choice, band, choice, fronts, grid_links
from rangeseg_ros.core.graphcut.moves import ROUNDING
from rangeseg_ros.core.runtime.threads import halves

# Shares of the smoothness under which regions grow, one after the other: under all of it at once,
# those that come first swallow what would have grown together beside them.
_SHARES = 0.4, 0.6, 0.8, 1.0
# Pixels that labels advance in the end, not counting those that gain by so many degrees.
_REACH, _ODD = 4, 15.0
# A label and those beside it.
_BESIDE = 8
# Share of the pixels where the data may speak against the labels of the image before.
_ANEW = 0.25


def minimise(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
    before: NDArray[np.integer] | None = None,
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
    before : (H, W) int, optional
        Labelling of a similar image, such as the frame before, to begin from; where it does not
        suit the data it is not used.

    Returns
    -------
    (H, W) intp
        Index into `directions`.
    """
    parts = pieces(normals, directions, horizontal, vertical, smoothness)
    warm = None if before is None else _warm(parts, before)
    labels, costs, graph = parts.votes.copy() if warm is None else warm, parts.costs, parts.graph
    for share in _SHARES if warm is None else _SHARES[-1:]:
        eased = graph._replace(links=np.float32(share) * graph.links)
        settle(labels, costs, eased)
        turn(labels, costs, eased)
    expand(labels, costs, graph)
    turn(labels, costs, graph)
    # Any label will do where neither an edge nor a normal is.
    result = np.append(labels, np.int32(0))[parts.image]
    _refine(result, normals, directions, horizontal, vertical, smoothness)
    _replace(result, normals, directions)
    return result.astype(np.intp)


def _warm(parts: Pieces, before: NDArray[np.integer]) -> NDArray[np.int32] | None:
    """Labels before (n,) of the pieces, but for those whose data speak against them.

    Those are where the vote saves more than half of the links of the piece, as where something
    moved. None if the scene looks like another one.
    """
    labels, every = parts.votes.copy(), np.arange(len(parts.votes))
    inside = parts.image >= 0
    labels[parts.image[inside]] = before[inside]
    links = np.concatenate([[0.0], np.cumsum(parts.graph.links, dtype=float)])
    bound = (links[parts.graph.start[1:]] - links[parts.graph.start[:-1]]) / 2
    lost = UNIT * (parts.costs[every, labels].astype(float) - parts.costs[every, parts.votes])
    against = lost > bound
    if against[parts.image[inside]].sum() > _ANEW * inside.sum():
        return None
    return np.where(against, parts.votes, labels)


def _refine(
    image: NDArray[np.int32],
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
) -> None:
    """Expand the labels of an image by some pixels, in place."""
    width, labels = image.shape[1], image.reshape(-1)
    sites = np.ascontiguousarray(normals, np.float32).reshape(-1, 3, 1)
    vectors = directions.astype(np.float32)
    links = grid_links(horizontal, vertical, smoothness)
    data = mixed_angles(labels, sites, vectors)
    position = np.full(len(labels), -1, np.int32)
    start, beside = fronts(labels, links, width, len(vectors))
    for alpha in np.flatnonzero(np.diff(start)).tolist():
        front = beside[start[alpha] : start[alpha + 1]]
        move = _move(alpha, front, sites, vectors[alpha], labels, data, links, width, position)
        move.make(alpha, labels, data, ROUNDING)


def _replace(
    image: NDArray[np.int32], normals: NDArray[np.float32], directions: NDArray[np.floating]
) -> None:
    """Replace labels by those beside them where that suits all of their pixels better, in place.

    The costs of pieces, which are those of cells, cannot tell labels so close from each other.
    """
    vectors = directions.astype(np.float32)
    near = np.argsort(-(vectors @ vectors.T), axis=1, kind='stable')[:, :_BESIDE]
    # (K, 3, m): the labels beside one next to each other, for the compiler to take all at a time.
    beside = np.ascontiguousarray(vectors[near].transpose(0, 2, 1))
    upper, lower = halves(_costs_beside, len(image), image, normals, beside)
    best = (upper + lower).argmin(axis=1)
    image[...] = near[np.arange(len(near)), best].astype(np.int32)[image]


@njit(cache=True, nogil=True)
def _costs_beside(
    first: int,
    after: int,
    image: NDArray[np.int32],
    normals: NDArray[np.float32],
    beside: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Data costs (K, m) of directions (K, 3, m) at the pixels that have each label."""
    total = np.zeros((len(beside), beside.shape[2]))
    for i in range(first, after):
        for j in range(image.shape[1]):
            x, y, z = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
            if x == x:
                k = np.uint32(image[i, j])
                for m in range(beside.shape[2]):
                    cosine = x * beside[k, 0, m] + y * beside[k, 1, m] + z * beside[k, 2, m]
                    total[k, m] += degrees(cosine)
    return total


@njit(cache=True)
def _move(
    alpha: int,
    front: NDArray[np.int32],
    normals: NDArray[np.float32],
    direction: NDArray[np.float32],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
    links: NDArray[np.float32],
    width: int,
    position: NDArray[np.int32],
) -> Choice:
    """Expansion of a label by the pixels about its front."""
    front = _onward(alpha, front, normals, direction, labels, data, links, width, position)
    near = band(alpha, front, _REACH, labels, links, width, position)
    new = angles(near, normals, direction)
    return choice(alpha, near, new, labels, data, links, width, position)


@njit(cache=True)
def _onward(
    alpha: int,
    front: NDArray[np.int32],
    normals: NDArray[np.float32],
    direction: NDArray[np.float32],
    labels: NDArray[np.int32],
    data: NDArray[np.float32],
    links: NDArray[np.float32],
    width: int,
    position: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Sites of a front, and on from there those that gain much by the label.

    `position` is -1 and becomes so again.
    """
    offsets = np.array([1, width, -1, -width])
    sites = np.empty(2 * len(front) + 64, np.int32)
    count = 0
    for p in front:
        if labels[p] != alpha and position[p] < 0:
            position[p] = count
            sites[count] = p
            count += 1
    done = 0
    while done < count:
        p = sites[done]
        done += 1
        for k in range(4):
            q = p + offsets[k]
            if (
                links[k % 2, min(p, q)] == 0
                or labels[q] == alpha
                or position[q] >= 0
                or data[q] <= _ODD
            ):
                continue
            cost = site_angle(normals[q], direction[0], direction[1], direction[2])
            if data[q] - cost > _ODD:
                if count == len(sites):
                    sites = np.concatenate((sites, np.empty_like(sites)))
                position[q] = count
                sites[count] = q
                count += 1
    for p in sites[:count]:
        position[p] = -1
    return sites[:count]
