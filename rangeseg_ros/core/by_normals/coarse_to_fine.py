"""Alpha-expansion on a pyramid of grids, from the coarsest to the pixels.

The energy is that of the pixels at every level (`pyramid`). The coarsest level begins with the
label nearest to the mean normal of each site and expands these labels over all of the image. Each
finer one begins with the labels of the level above and expands them near borders.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.angles import degrees
from rangeseg_ros.core.by_normals.pyramid import Pyramid
from rangeseg_ros.core.graphcut.cut import ROUNDING
from rangeseg_ros.core.graphcut.expansion import expand
from rangeseg_ros.core.graphcut.sites import (
    GridLabelling,
    Sites,
    band,
    beyond,
    fronts,
    group_sites,
)
from rangeseg_ros.core.runtime.threads import run_halves, run_rows
from rangeseg_ros.core.sensing.grid import Grid

# Sites of the coarsest level are 8 pixels wide, 4800 in VGA.
_LEVELS = 3
# The share of a site in the border around its region is that of a region of so many sites across:
# what a label may cost it at the coarsest level, and has to save it at others away from borders.
_REGION = 6
# Sites from a border that a label is expanded to: two of the level above.
_REACH = 4


class _Observed(NamedTuple):
    """What is observed, and what it is compared with.

    Attributes
    ----------
    normals : (H, W, 3) float32
        NaN where undefined.
    top : (H, W) uint8
        See `Pyramid`.
    vectors : (K, 3) float32
        Directions of the labels.
    """

    normals: NDArray[np.float32]
    top: NDArray[np.uint8]
    vectors: NDArray[np.float32]


def minimise(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    grid: Grid,
    smoothness: float,
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

    Returns
    -------
    (H, W) int32
        Index into `directions`.
    """
    pyramid = Pyramid.of(grid, smoothness, _LEVELS)
    arrays = normals, pyramid.top, directions
    observed = _Observed(*map(np.ascontiguousarray, arrays, (np.float32, np.uint8, np.float32)))
    labels = np.full(pyramid.links[-1].shape[1:], -1, np.int32)
    for level in range(_LEVELS, -1, -1):
        if level < _LEVELS:
            labels = _handed_down(labels, pyramid.members[level])
        height, width = labels.shape
        links = pyramid.links[level].reshape(2, -1)
        _fill_in(labels, level, observed, links)
        data = np.empty(labels.shape, np.float32)
        run_rows(_sum_chosen, height, labels, level, observed, data)
        labelling = GridLabelling.of(labels.reshape(-1), data.ravel(), links, width)
        if level == _LEVELS:
            _expand_all(labels.copy(), observed, labelling)
        else:
            run_halves(_expand_near, height, level, observed, labelling)
    return labels


def _handed_down(labels: NDArray[np.int32], member: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Labels (h, w) of a level from those of the next one, -1 where a site is no part of that."""
    height, width = member.shape
    finer = labels.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(member, finer, np.int32(-1))


def _fill_in(
    labels: NDArray[np.int32], level: int, observed: _Observed, links: NDArray[np.float32]
) -> None:
    """Give sites of -1 the label of what they are linked to, else the one nearest to their normal.

    In place; any will do where neither is.
    """
    width = labels.shape[1]
    _spread(labels.reshape(-1), links, width)
    run_rows(_observe, len(labels), labels, level, observed)
    _spread(labels.reshape(-1), links, width)
    np.maximum(labels, 0, out=labels)


@njit(cache=True, nogil=True)
def _spread(labels: NDArray[np.int32], links: NDArray[np.float32], width: int) -> None:
    """Give sites (n,) of -1 the label of the nearest site that is linked to them; in place."""
    offsets = np.array([1, width, -1, -width])
    queue = np.empty(len(labels), np.int32)
    last = done = 0
    for p in range(len(labels)):
        for k in range(4):
            q = p + offsets[k]
            if labels[p] >= 0 and links[k % 2, min(p, q)] > 0 and labels[q] < 0:
                queue[last] = p
                last += 1
                break
    while done < last:
        p = queue[done]
        done += 1
        for k in range(4):
            q = p + offsets[k]
            if links[k % 2, min(p, q)] > 0 and labels[q] < 0:
                labels[q] = labels[p]
                queue[last] = q
                last += 1


@njit(cache=True, nogil=True)
def _observe(
    first: int, after: int, labels: NDArray[np.int32], level: int, observed: _Observed
) -> None:
    """Give sites of -1, in some rows, the label nearest to their mean normal; in place."""
    for a in range(first, after):
        for b in range(labels.shape[1]):
            if labels[a, b] < 0:
                labels[a, b] = _nearest(a, b, level, observed)


@njit(cache=True, nogil=True)
def _nearest(a: int, b: int, level: int, observed: _Observed) -> int:
    """Label nearest to the mean normal of a site, -1 for none."""
    normals, top, vectors = observed.normals, observed.top, observed.vectors
    x = y = z = np.float32(0)
    for i in range(a << level, min((a + 1) << level, len(top))):
        for j in range(b << level, min((b + 1) << level, top.shape[1])):
            if top[i, j] >= level and normals[i, j, 0] == normals[i, j, 0]:
                x += normals[i, j, 0]
                y += normals[i, j, 1]
                z += normals[i, j, 2]
    best, most = -1, np.float32(-np.inf)
    for k in range(len(vectors) if x != 0 or y != 0 or z != 0 else 0):
        along = x * vectors[k, 0] + y * vectors[k, 1] + z * vectors[k, 2]
        if along > most:
            best, most = k, along
    return best


@njit(cache=True, nogil=True, inline='always')
def _cost(a: int, b: int, label: int, level: int, observed: _Observed) -> np.float32:
    """Data cost of a label at a site: the sum over its pixels."""
    normals, top, vector = observed.normals, observed.top, observed.vectors[label]
    x, y, z = vector[0], vector[1], vector[2]
    total = np.float32(0)
    for i in range(a << level, min((a + 1) << level, len(top))):
        for j in range(b << level, min((b + 1) << level, top.shape[1])):
            if top[i, j] >= level:
                normal = normals[i, j]
                total += degrees(normal[0] * x + normal[1] * y + normal[2] * z)
    return total


@njit(cache=True, nogil=True)
def _sum_chosen(
    first: int,
    after: int,
    labels: NDArray[np.int32],
    level: int,
    observed: _Observed,
    data: NDArray[np.float32],
) -> None:
    """Data costs of the labels of some rows of sites."""
    for a in range(first, after):
        for b in range(labels.shape[1]):
            data[a, b] = _cost(a, b, labels[a, b], level, observed)


def _expand_all(labels: NDArray[np.int32], observed: _Observed, labelling: GridLabelling) -> None:
    """Expand the labels (h, w) that there are over all of the coarsest level; in place."""
    tried = np.unique(labels)
    vectors = np.ascontiguousarray(observed.vectors[tried].T)
    costs = np.zeros((*labels.shape, len(tried)), np.float32)
    run_rows(_sum_angles, len(labels), observed.normals, observed.top, vectors, costs)
    _expand_each(tried, np.ascontiguousarray(costs.reshape(-1, len(tried)).T), labelling)


@njit(cache=True, nogil=True)
def _sum_angles(
    first: int,
    after: int,
    normals: NDArray[np.float32],
    top: NDArray[np.uint8],
    vectors: NDArray[np.float32],
    costs: NDArray[np.float32],
) -> None:
    """Data costs (h, w, t) of directions (3, t) at some rows of sites of the coarsest level."""
    a, b, c = vectors[0], vectors[1], vectors[2]
    for i in range(first << _LEVELS, min(after << _LEVELS, len(top))):
        for j in range(top.shape[1]):
            if top[i, j] < _LEVELS or normals[i, j, 0] != normals[i, j, 0]:
                continue
            x, y, z = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
            sums = costs[i >> _LEVELS, j >> _LEVELS]
            for t in range(len(sums)):
                sums[t] += degrees(a[t] * x + b[t] * y + c[t] * z)


@njit(cache=True, nogil=True)
def _expand_each(
    tried: NDArray[np.int32], costs: NDArray[np.float32], labelling: GridLabelling
) -> None:
    """Expand labels (t,) once, given what they cost (t, n); in place."""
    labels, data, position = labelling.labels, labelling.data, labelling.position
    share = _border_shares(labelling)
    sites, new = np.empty(len(labels), np.int32), np.empty(len(labels), np.float32)
    for t in range(len(tried)):
        count = 0
        for p in range(len(labels)):
            if labels[p] != tried[t] and costs[t, p] - data[p] < share[p]:
                sites[count], new[count], position[p] = p, costs[t, p], count
                count += 1
        if count > 0:
            expand(int(tried[t]), sites[:count], new[:count], labelling, ROUNDING)


@njit(cache=True, nogil=True)
def _expand_near(
    rows: tuple[int, int], level: int, observed: _Observed, labelling: GridLabelling
) -> None:
    """Expand every label in some rows, as far as it gains; in place.

    From the borders of its regions, and from the sites that it suits much better than theirs.
    """
    width, count = labelling.width, len(observed.vectors)
    start, beside = fronts(labelling.labels, labelling.links, width, count, rows)
    begin, suited = _suited(rows, level, observed, labelling)
    for alpha in range(count):
        borders = beside[start[alpha] : start[alpha + 1]]
        front = np.concatenate((borders, suited[begin[alpha] : begin[alpha + 1]]))
        while len(front) > 0:
            sites = band(alpha, front, _REACH, labelling, rows)
            new = np.empty(len(sites), np.float32)
            for s in range(len(sites)):
                new[s] = _cost(sites[s] // width, sites[s] % width, alpha, level, observed)
            if not expand(alpha, sites, new, labelling, ROUNDING):
                break
            front = beyond(alpha, sites, labelling, rows)


@njit(cache=True, nogil=True)
def _suited(
    rows: tuple[int, int], level: int, observed: _Observed, labelling: GridLabelling
) -> Sites:
    """Sites in some rows of which another label would save more than their share of a border.

    Not of single pixels, whose normals are mostly noise.
    """
    width, data, share = labelling.width, labelling.data, _border_shares(labelling)
    first, after = rows[0] * width, rows[1] * width
    sites, suits = np.empty(after - first, np.int32), np.empty(after - first, np.int32)
    found = 0
    for p in range(first, after if level > 0 else first):
        if data[p] > share[p]:
            label = _nearest(p // width, p % width, level, observed)
            cost = _cost(p // width, p % width, label, level, observed)
            if data[p] - cost > share[p]:
                sites[found], suits[found] = p, label
                found += 1
    return group_sites(suits[:found], sites[:found], len(observed.vectors))


@njit(cache=True, nogil=True)
def _border_shares(labelling: GridLabelling) -> NDArray[np.float32]:
    """Share (n,) of each site in the border around a region of `_REGION` sites across."""
    links, width = labelling.links, labelling.width
    total = links[0] + links[1]
    total[1:] += links[0, :-1]
    total[width:] += links[1, :-width]
    return total / np.float32(_REGION)
