"""First planes: blocks grow to patches, patches join to surfaces.

Agglomerative clustering on the adjacency of blocks, as in Feng, Taguchi and Kamat (ICRA 2014),
with tests that count the sensor's variances. Real sensors bend planes smoothly, so how far two
parts may leave their common plane cannot be one number: the plane a patch of a wall suggests is
off by the distortion where the wall ends, yet the patch beside it agrees. Hence two steps. Blocks
merge to patches small enough for the distortion to be nearly constant; patches join where they
agree with their neighbours, averaged along the common border, and the surface as a whole stays
within the distortion.
"""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.blocks import Links
from rangeseg_ros.core.moments import COUNT, RATIO, SIZE, common_residual, fit
from rangeseg_ros.core.threads import halves

DISTORTION_PIXELS = 2000.0
"""Regions of this size meet half the variance of the distortion, large ones all of it."""
# Quantile 0.999 of chi-squared with the three degrees of freedom of a plane, for pixels of
# whose noise four agree.
_NOISE = 16.0 * 4.0
# Extra chi-squared of one plane for four blocks, with nine degrees of freedom, below which they
# are merged at once.
_CLEAR = 24.0
# Systematic variances granted between blocks of a patch, between neighbouring patches, and
# within a surface (4 standard deviations).
_WITHIN_PATCH, _BETWEEN_PATCHES, _WITHIN_SURFACE = 2.0, 10.0, 30.0
# Blocks of a patch: the distortion of a Kinect is nearly constant over 40 x 40 pixels at VGA.
_PATCH_MINIMUM, _PATCH_LARGEST = 5, 94
# Blocks that may lie between the parts of a face.
_GAP = 4
# Residuals of a block, in variances, beyond which it is no part of a plane.
_ROUGH = 10.0


def surfaces(
    moments: NDArray[np.float64], links: Links, block: int, least: int = 1
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Group blocks into planar surfaces.

    Parameters
    ----------
    moments : (rows, columns, 13) float64
        Of blocks, weighted; zeros for blocks to leave out.
    links : Links
        Which neighbouring blocks are connected.
    block : int
        Rows and columns of a block.
    least : int
        Pixels of the smallest surface.

    Returns
    -------
    labels : (rows, columns) int
        0 where no surface is, otherwise 1...K.
    moments : (K + 1, 13) float64
        Of the surfaces; zeros for 0.
    """
    shape = moments.shape[:2]
    blocks = moments.reshape(-1, SIZE)
    # No patch reaches over the middle, but neither does any reach across a large surface.
    roots = halves(_patches, shape[0], moments, *links, _PATCH_LARGEST * block**2)
    patch, moments = _renumbered(np.concatenate(roots), blocks, _PATCH_MINIMUM * block**2)
    border = _borders(patch.reshape(shape), *links, len(moments))
    surface, moments = _renumbered(_join(moments, border, _BETWEEN_PATCHES), moments, least)
    labels = surface[patch].reshape(shape)
    # A neck narrower than a block, or a row of holes, may keep parts of a face from touching.
    root = _join(moments, _nearby(labels, len(moments)), _WITHIN_PATCH)
    surface, moments = _renumbered(root, moments, 1)
    return surface[labels], moments


@njit(cache=True, nogil=True)
def _patches(
    first: int,
    after: int,
    moments: NDArray[np.float64],
    right: NDArray[np.bool_],
    below: NDArray[np.bool_],
    largest: float,
) -> NDArray[np.intp]:
    """Group some rows of blocks into patches; number of the block at the root of each block's."""
    shape = after - first, moments.shape[1]
    blocks = moments[first:after].copy().reshape(-1, SIZE)
    right, below = right[first:after], below[first : max(after - 1, first)]
    theta = np.zeros(3)
    residual = np.zeros(len(blocks))
    smooth = np.zeros(len(blocks), np.bool_)
    for a in range(len(blocks)):
        residual[a] = fit(blocks[a], theta)
        smooth[a] = residual[a] < _ROUGH * blocks[a, COUNT]
    pairs = _pairs(smooth.reshape(shape), right, below)
    parent = _quads(blocks, residual, smooth.reshape(shape), right, below)
    return _grow(blocks, residual, smooth, pairs, parent, largest) + first * shape[1]


@njit(cache=True)
def _pairs(
    smooth: NDArray[np.bool_], right: NDArray[np.bool_], below: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Numbers of smooth blocks that touch, (N, 2)."""
    rows, columns = smooth.shape
    pairs = np.empty((2 * rows * columns, 2), np.intp)
    count = 0
    for i in range(rows):
        for j in range(columns):
            here = i * columns + j
            if not smooth[i, j]:
                continue
            if j + 1 < columns and right[i, j] and smooth[i, j + 1]:
                pairs[count] = here, here + 1
                count += 1
            if i + 1 < rows and below[i, j] and smooth[i + 1, j]:
                pairs[count] = here, here + columns
                count += 1
    return pairs[:count]


@njit(cache=True)
def _renumbered(
    root: NDArray[np.intp], moments: NDArray[np.float64], least: float
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Number the clusters of at least so many pixels 1...K, the rest 0; their moments."""
    count = np.zeros(len(root))
    for a in range(len(root)):
        count[root[a]] += moments[a, COUNT]
    number = np.zeros(len(root), np.intp)
    clusters = 0
    for a in range(len(root)):
        if count[a] >= least:
            clusters += 1
            number[a] = clusters
    labels = np.zeros(len(root), np.intp)
    total = np.zeros((clusters + 1, SIZE))
    for a in range(len(root)):
        labels[a] = number[root[a]]
        if labels[a] > 0:
            for entry in range(SIZE):
                total[labels[a], entry] += moments[a, entry]
    return labels, total


@njit(cache=True)
def _borders(
    patch: NDArray[np.intp], right: NDArray[np.bool_], below: NDArray[np.bool_], count: int
) -> NDArray[np.float64]:
    """Length of the border between every two patches, in blocks: (count, count), symmetric."""
    rows, columns = patch.shape
    border = np.zeros((count, count))
    for i in range(rows):
        for j in range(columns):
            a = patch[i, j]
            for k in range(2):
                if k == 0 and (j + 1 == columns or not right[i, j]):
                    continue
                if k == 1 and (i + 1 == rows or not below[i, j]):
                    continue
                b = patch[i, j + 1] if k == 0 else patch[i + 1, j]
                if a != b and a > 0 and b > 0:
                    border[a, b] += 1
                    border[b, a] += 1
    return border


@njit(cache=True)
def _nearby(labels: NDArray[np.intp], count: int) -> NDArray[np.float64]:
    """Pairs of blocks within `_GAP` of each other, of every two surfaces: as `_borders`."""
    rows, columns = labels.shape
    near = np.zeros((count, count))
    for i in range(rows):
        for j in range(columns):
            a = labels[i, j]
            inner = 0 < j < columns - 1 and labels[i, j - 1] == a and labels[i, j + 1] == a
            if a == 0 or (inner and i + 1 < rows and labels[i + 1, j] == a):
                continue
            for ni in range(i, min(i + _GAP + 1, rows)):
                for nj in range(max(j - _GAP, 0), min(j + _GAP + 1, columns)):
                    b = labels[ni, nj]
                    if b > 0 and b != a:
                        near[a, b] += 1
                        near[b, a] += 1
    return near


@njit(cache=True)
def _misfit(
    extra: float, first: NDArray[np.float64], second: NDArray[np.float64], granted: float
) -> float:
    """Extra residual of a common plane, in what noise and distortion are granted; 1 is too far."""
    pixels = first[COUNT] + second[COUNT]
    ratio = (first[RATIO] + second[RATIO]) / pixels
    return extra / (_NOISE + granted * ratio * first[COUNT] * second[COUNT] / pixels)


@njit(cache=True)
def _quads(
    moments: NDArray[np.float64],
    residual: NDArray[np.float64],
    smooth: NDArray[np.bool_],
    right: NDArray[np.bool_],
    below: NDArray[np.bool_],
) -> NDArray[np.intp]:
    """Merge every 2 x 2 blocks that clearly lie on one plane; in place.

    Most blocks do; merging these at once saves the queue of `_grow` most of its work. Returns
    the parent of each block.
    """
    rows, columns = smooth.shape
    parent = np.arange(rows * columns)
    theta, total = np.zeros(3), np.zeros(SIZE)
    for i in range(0, rows - 1, 2):
        for j in range(0, columns - 1, 2):
            if not (
                smooth[i, j] and smooth[i, j + 1] and smooth[i + 1, j] and smooth[i + 1, j + 1]
            ):
                continue
            if not (right[i, j] and right[i + 1, j] and below[i, j] and below[i, j + 1]):
                continue
            a = i * columns + j
            apart = 0.0
            total[:] = 0
            for b in (a, a + 1, a + columns, a + columns + 1):
                total += moments[b]
                apart += residual[b]
            together = fit(total, theta)
            if together - apart < _CLEAR:
                parent[a + 1] = parent[a + columns] = parent[a + columns + 1] = a
                moments[a], residual[a] = total, together
    return parent


@njit(cache=True)
def _grow(
    moments: NDArray[np.float64],
    residual: NDArray[np.float64],
    nodes: NDArray[np.bool_],
    pairs: NDArray[np.intp],
    parent: NDArray[np.intp],
    largest: float,
) -> NDArray[np.intp]:
    """Merge blocks to patches of at most `largest` pixels, the flattest first, each with the
    neighbour it fits best; in place.

    Returns the root of each block's patch, itself for a block that is no node.
    """
    count = len(moments)
    # Adjacency lists as chained half-edges: the lists of merged patches join in constant time.
    head, tail = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
    link = np.full(2 * len(pairs), -1, np.int32)
    target = np.empty(2 * len(pairs), np.int32)
    for e in range(2 * len(pairs)):
        a, b = parent[pairs[e // 2, e % 2]], parent[pairs[e // 2, 1 - e % 2]]
        target[e], link[e] = b, head[a]
        head[a] = e
        if tail[a] < 0:
            tail[a] = e
    version = np.zeros(count, np.int64)
    heap = [(0.0, 0, 0)]
    heap.pop()
    for a in range(count):
        if nodes[a] and parent[a] == a:
            heappush(heap, (residual[a] / moments[a, COUNT], a, 0))
    seen = np.full(count, -1, np.int32)
    turn = 0
    while len(heap) > 0:
        _, a, age = heappop(heap)
        if parent[a] != a or version[a] != age:
            continue
        turn += 1
        best, partner = 1.0, -1
        before, e = -1, head[a]
        while e >= 0:
            b = target[e]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            target[e] = b
            following = link[e]
            if b == a or seen[b] == turn:
                # An inner edge, or one more to the same patch.
                if before < 0:
                    head[a] = following
                else:
                    link[before] = following
                if following < 0:
                    tail[a] = before
            else:
                seen[b] = turn
                before = e
                if moments[a, COUNT] + moments[b, COUNT] <= largest:
                    extra = common_residual(moments[a], moments[b]) - residual[a] - residual[b]
                    misfit = _misfit(extra, moments[a], moments[b], _WITHIN_PATCH)
                    if misfit < best:
                        best, partner = misfit, b
            e = following
        if partner >= 0:
            residual[a] = common_residual(moments[a], moments[partner])
            moments[a] += moments[partner]
            parent[partner] = a
            if head[partner] >= 0:
                link[tail[a]] = head[partner]
                tail[a] = tail[partner]
            version[a] += 1
            heappush(heap, (residual[a] / moments[a, COUNT], a, version[a]))
    return _roots(parent)


@njit(cache=True)
def _join(
    moments: NDArray[np.float64], border: NDArray[np.float64], granted: float
) -> NDArray[np.intp]:
    """Join patches 1...P to surfaces, those that agree best first; returns the roots.

    The strain between two surfaces is the mean misfit of the patches on either side of their
    border, where so many systematic variances are granted.
    """
    count = len(moments)
    moments, border = moments.copy(), border.copy()
    theta = np.zeros(3)
    residual = np.zeros(count)
    for a in range(count):
        residual[a] = fit(moments[a], theta)
    strain = np.zeros((count, count))
    heap = [(0.0, 0, 0)]
    heap.pop()
    for a in range(count):
        for b in range(a + 1, count):
            if border[a, b] > 0:
                extra = common_residual(moments[a], moments[b]) - residual[a] - residual[b]
                misfit = _misfit(extra, moments[a], moments[b], granted)
                strain[a, b] = strain[b, a] = misfit * border[a, b]
                heappush(heap, (strain[a, b] / border[a, b], a, b))
    parent = np.arange(count)
    while len(heap) > 0:
        mean, a, b = heappop(heap)
        if mean >= 1:
            break
        if parent[a] != a or parent[b] != b or strain[a, b] / border[a, b] != mean:
            continue
        chi2 = common_residual(moments[a], moments[b])
        extra = chi2 - residual[a] - residual[b]
        pixels = moments[a, COUNT] + moments[b, COUNT]
        within = _WITHIN_SURFACE * pixels / (pixels + DISTORTION_PIXELS)
        if _misfit(extra, moments[a], moments[b], within) >= 1:
            continue
        parent[b] = a
        moments[a] += moments[b]
        residual[a] = chi2
        for c in range(count):
            if border[b, c] > 0 and c != a:
                border[a, c] += border[b, c]
                strain[a, c] += strain[b, c]
                border[c, a], strain[c, a] = border[a, c], strain[a, c]
            border[b, c] = border[c, b] = 0
            if border[a, c] > 0:
                heappush(heap, (strain[a, c] / border[a, c], min(a, c), max(a, c)))
    return _roots(parent)


@njit(cache=True)
def _roots(parent: NDArray[np.intp]) -> NDArray[np.intp]:
    """Root of every node of a forest given by parents."""
    root = np.empty(len(parent), np.intp)
    for a in range(len(parent)):
        b = a
        while parent[b] != b:
            b = parent[b]
        root[a] = b
    return root
