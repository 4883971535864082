"""Fast minimiser: superpixels of the image first, then pixels around the boundaries.

The energy of labellings that are constant on pieces is lowered by giving every connected region of
pieces its best label, under a prior that grows to its full weight. Then every label is expanded
once over the pixels around its boundaries.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.angles import UNIT, angles, chosen_angles, degrees
from rangeseg_ros.core.by_normals.piece_moves import relabel_regions
from rangeseg_ros.core.by_normals.pieces import Pieces, pieces
from rangeseg_ros.core.graphcut.cut import ROUNDING
from rangeseg_ros.core.graphcut.energy import link_costs
from rangeseg_ros.core.graphcut.expansion import expand
from rangeseg_ros.core.graphcut.sites import GridLabelling, Sites, band, fronts
from rangeseg_ros.core.sensing.grid import Grid

# Shares of the smoothness under which regions grow, one after the other: under all of it at once,
# those that come first swallow what would have grown together beside them.
_PRIOR_SHARES = 0.4, 0.6, 0.8, 1.0
# Pixels from a boundary that a label is expanded to: half a tile, as far as a boundary of pieces
# may lie beside that of pixels.
_BAND_PIXELS = 4
# A label reaches farther where it gains more than this, two steps of the 305 directions: there the
# pixels beyond a boundary are another surface, not noise of this one.
_OUTLIER_DEGREES = 15.0


def minimise(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    grid: Grid,
    smoothness: float,
    before: NDArray[np.integer] | None = None,
) -> NDArray[np.int32]:
    """Labelling of low energy, eq. 5.3 with the angle to the normals as data cost (eq. 5.5).

    Parameters
    ----------
    normals : (H, W, 3) float32
        NaN where undefined.
    directions : (K, 3) float
    grid : Grid
        (H, W).
    smoothness : float
        Lambda.
    before : (H, W) int, optional
        Labelling of a similar image, such as the frame before, to begin from; where it does not
        suit the data it is not used.

    Returns
    -------
    (H, W) int32
        Index into `directions`.
    """
    parts = pieces(normals, directions, grid, smoothness)
    warm = None if before is None else _warm(parts, before)
    labels, costs, graph = parts.votes.copy() if warm is None else warm, parts.costs, parts.graph
    for share in _PRIOR_SHARES if warm is None else _PRIOR_SHARES[-1:]:
        relabel_regions(labels, costs, graph._replace(links=np.float32(share) * graph.links))
    # Any label will do where neither an edge nor a normal is.
    result = np.append(labels, np.int32(0))[parts.image]
    _expand(result, normals, directions, grid, smoothness)
    return result


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
    if 2 * against[parts.image[inside]].sum() > inside.sum():
        return None
    return np.where(against, parts.votes, labels)


def _expand(
    image: NDArray[np.int32],
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    grid: Grid,
    smoothness: float,
) -> None:
    """Expand the labels of an image around their boundaries, in place."""
    width, labels = image.shape[1], image.reshape(-1)
    sites = np.ascontiguousarray(normals, np.float32).reshape(-1, 3)
    vectors = directions.astype(np.float32)
    links = link_costs(grid, smoothness)
    labelling = GridLabelling.of(labels, chosen_angles(labels, sites, vectors), links, width)
    near = fronts(labels, links, width, len(vectors), (0, len(image)))
    _expand_each(sites, vectors, labelling, near)


@njit(cache=True, nogil=True)
def _expand_each(
    normals: NDArray[np.float32],
    vectors: NDArray[np.float32],
    labelling: GridLabelling,
    near: Sites,
) -> None:
    """Expand each label once, to the pixels about its front; in place."""
    start, beside = near
    rows = 0, len(labelling.labels) // labelling.width
    for alpha in range(len(vectors)):
        front = beside[start[alpha] : start[alpha + 1]]
        if len(front):
            front = _onward(alpha, front, normals, vectors[alpha], labelling)
            sites = band(alpha, front, _BAND_PIXELS, labelling, rows)
            new = angles(sites, normals, vectors[alpha])
            expand(alpha, sites, new, labelling, ROUNDING)


@njit(cache=True, nogil=True)
def _onward(
    alpha: int,
    front: NDArray[np.int32],
    normals: NDArray[np.float32],
    direction: NDArray[np.float32],
    labelling: GridLabelling,
) -> NDArray[np.int32]:
    """Sites of a front, and on from there those that gain much by the label.

    `labelling.position` is -1 and becomes so again.
    """
    labels, data = labelling.labels, labelling.data
    links, position = labelling.links, labelling.position
    offsets = np.array([1, labelling.width, -1, -labelling.width])
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
                or data[q] <= np.float32(_OUTLIER_DEGREES)
            ):
                continue
            cost = degrees(
                normals[q, 0] * direction[0]
                + normals[q, 1] * direction[1]
                + normals[q, 2] * direction[2]
            )
            if data[q] - cost > np.float32(_OUTLIER_DEGREES):
                if count == len(sites):
                    sites = np.concatenate((sites, np.empty_like(sites)))
                position[q] = count
                sites[count] = q
                count += 1
    for p in sites[:count]:
        position[p] = -1
    return sites[:count]
