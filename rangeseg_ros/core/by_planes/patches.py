"""Blocks grow to patches small enough for the sensor's distortion to be nearly constant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Ints, Mask
from rangeseg_ros.core.by_planes.region_graph import find_roots, make_sets, renumbered
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import NODE, Blocks
from rangeseg_ros.core.sensing.grid import Grid, View
from rangeseg_ros.core.sensing.moments import CHI2, COUNT, RATIO, SIZE, SLOPE, common_residual, fit
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    random_variance,
    systematic_variance,
    tilt_variance,
)
from rangeseg_ros.core.significance import OUTLIER, chi2_quantile

# Fewest measurements of a block, bridged holes included: a plane has three parameters.
_LEAST = 3
# Chi-squared of the three degrees of freedom of a plane.
_CHI2_LIMIT = chi2_quantile(3)
# Extra chi-squared of one plane for four blocks, with nine degrees of freedom, below which they
# are merged at once: quantile 0.996.
_CLEAR = 24.0
# Systematic variances granted between blocks of a patch: that of a difference is twice one.
_GRANTED = 2.0
# Residuals of a block, in variances, beyond which it is no part of a plane.
_ROUGH = OUTLIER**2
# Steps of a variance by which patches are told to be flatter: the mean residual of the largest
# patch scatters by 0.04, and less than a step is often rounding.
_PER_VARIANCE = 256
# Patches are nearly never rougher than their blocks.
_LEVELS = 16 * _PER_VARIANCE
# Above all numbers of patches.
_NONE = np.uint32(0xFFFFFFFF)


class Nodes(NamedTuple):
    """The blocks (rows, columns) that surfaces are grown from.

    `moments` (..., 13) have weights according to the sensor, and the ratios of its variances;
    zeros for blocks to leave out: that a jump crosses or that lack two measurements. `residual` is
    what the plane through each leaves, with these weights. `right` (rows, columns - 1) and `below`
    (rows - 1, columns) tell whether a block touches its right, its lower neighbour.
    """

    moments: Floats
    residual: Floats
    right: Mask
    below: Mask

    @classmethod
    def of(cls, view: View) -> Nodes:
        """Those of an image, holes bridged: a row of pixels alone determines no plane."""
        blocks = view.nodes or Blocks.of(view.whole, NODE)
        rows, columns = blocks.squared.shape
        right = np.zeros((rows, columns - 1), np.bool_)
        below = np.zeros((rows - 1, columns), np.bool_)
        map_halves(_weigh, rows, blocks, view.whole.valid, view.grid, view.sensor, right, below)
        return cls(blocks.moments, blocks.residual, right, below)


@njit(cache=True, nogil=True, error_model='numpy')
def _weigh(
    first: int,
    after: int,
    blocks: Blocks,
    valid: Mask,
    grid: Grid,
    sensor: SensorModel,
    right: Mask,
    below: Mask,
) -> None:
    """Weigh moments and residuals of rows first...after of blocks, in place; tell which touch.

    Blocks touch where an edge joins a pixel of one and a pixel of the other. A jump crosses one
    where it parts two of its measured pixels.
    """
    (height, width), columns = valid.shape, blocks.squared.shape[1]
    for bi in range(first, after):
        bottom = min((bi + 1) * NODE, height)
        for bj in range(columns):
            end, crossed = min((bj + 1) * NODE, width), False
            for i in range(bi * NODE, bottom):
                for j in range(bj * NODE, end):
                    if j + 1 < end:
                        crossed |= valid[i, j] and valid[i, j + 1] and not grid.right[i, j]
                    elif j + 1 < width:
                        right[bi, bj] |= grid.right[i, j]
                    if i + 1 < bottom:
                        crossed |= valid[i, j] and valid[i + 1, j] and not grid.below[i, j]
                    elif i + 1 < height:
                        below[bi, bj] |= grid.below[i, j]
            moments, squared = blocks.moments[bi, bj], blocks.squared[bi, bj]
            count = moments[COUNT] * (moments[COUNT] >= _LEAST and not crossed)
            level = random_variance(sensor, squared)
            tilt = tilt_variance(sensor, blocks.slope[bi, bj]) / level
            weight = (count > 0) / (level * (1 + tilt))
            for k in range(CHI2 + 1):
                moments[k] *= weight
            moments[COUNT], moments[SLOPE] = count, count * tilt
            moments[RATIO] = count * weight * systematic_variance(sensor, squared)
            blocks.residual[bi, bj] *= weight


def find_patches(nodes: Nodes, sensor: SensorModel) -> tuple[Ints, Floats]:
    """Connected blocks on one plane, over which the distortion is nearly constant.

    The patch (rows, columns) of each block, 0 for none, otherwise 1...P, and moments (P + 1, 13).
    """
    # Halves are independent: patches that end at the middle are merged later, to surfaces. Even
    # in small images a patch may grow to four blocks.
    largest = max(sensor.distortion_pixels, 4.0 * NODE**2)
    halves = map_halves(_patches, len(nodes.residual), nodes, largest, sensor.block_inflation)
    (upper, first), (lower, second) = halves
    lower[lower > 0] += len(first) - 1
    labels, moments = np.concatenate([upper, lower]), np.concatenate([first, second[1:]])
    return labels.reshape(nodes.residual.shape), moments


@njit(cache=True, nogil=True)
def _patches(
    first: int, after: int, nodes: Nodes, largest: float, block_inflation: float
) -> tuple[Ints, Floats]:
    """Patches of at most `largest` pixels in some rows of blocks, 1...P, and their moments.

    `block_inflation`: variance of the noise of blocks over that of white noise.
    """
    shape = after - first, nodes.residual.shape[1]
    blocks = nodes.moments[first:after].copy().reshape(-1, SIZE)
    residual = nodes.residual[first:after].copy().reshape(-1)
    right, below = nodes.right[first:after], nodes.below[first : max(after - 1, first)]
    smooth = np.zeros(len(blocks), np.bool_)
    for a in range(len(blocks)):
        smooth[a] = residual[a] < _ROUGH * blocks[a, COUNT]
    root = find_roots(_quads(blocks, residual, smooth.reshape(shape), right, below, largest))
    # Close together, as those that are left fit into the cache.
    kept, count = np.empty(len(root), np.intp), 0
    number = np.zeros(len(root), np.uint32)
    for a in range(len(root)):
        if root[a] == a and blocks[a, COUNT] > 0:
            kept[count], number[a], count = a, count, count + 1
    kept = kept[:count]
    chains = _chains(number[root], smooth.reshape(shape), right, below, count)
    grown = _grow(blocks[kept], residual[kept], chains, largest, block_inflation)
    labels, moments = renumbered(grown, blocks[kept], 1.0)
    patch = np.zeros(len(root), np.int32)
    for a in range(len(root)):
        if blocks[a, COUNT] > 0:
            patch[a] = labels[number[root[a]]]
    return patch, moments


@njit(cache=True)
def _chains(
    number: NDArray[np.uint32], smooth: Mask, right: Mask, below: Mask, count: int
) -> tuple[NDArray[np.uint32], ...]:
    """Half-edges between `count` parts, whose `number` blocks have, where smooth blocks touch.

    The first and the last half-edge of each part; of each the next one, and the part it leads to.
    """
    rows, columns = smooth.shape
    head, tail = np.full(count, _NONE), np.full(count, _NONE)
    link, target = np.full(4 * smooth.size, _NONE), np.empty(4 * smooth.size, np.uint32)
    e = np.uint32(0)
    for i in range(rows):
        for j in range(columns):
            for u, v in ((i, j + 1), (i + 1, j)):
                if u == rows or v == columns or not (smooth[i, j] and smooth[u, v]):
                    continue
                a, b = number[i * columns + j], number[u * columns + v]
                if a == b or not (right[i, j] if u == i else below[i, j]):
                    continue
                for _ in range(2):
                    target[e], link[e], head[a] = b, head[a], e
                    if tail[a] == _NONE:
                        tail[a] = e
                    a, b = b, a
                    e += np.uint32(1)
    return head, tail, link, target


@njit(cache=True, error_model='numpy')
def _misfit(extra: float, moments: Floats, k: int, m: int, block_inflation: float) -> float:
    """Extra chi-squared of one plane for two of the parts (N, 13), in what it may be at most."""
    first, second = moments[k, COUNT], moments[m, COUNT]
    pixels = first + second
    ratio = (moments[k, RATIO] + moments[m, RATIO]) / pixels
    return extra / (block_inflation * _CHI2_LIMIT + _GRANTED * ratio * first * second / pixels)


@njit(cache=True)
def _quads(
    moments: Floats, residual: Floats, smooth: Mask, right: Mask, below: Mask, largest: float
) -> Indices:
    """Merge every 2 x 2 blocks that clearly lie on one plane, and 2 x 2 of these; in place.

    Most blocks do; merging these at once saves the queue of `_grow` most of its work. Returns
    the parent of each block.
    """
    rows, columns = smooth.shape
    parent = make_sets(rows * columns)
    theta, total = np.zeros((1, 3)), np.zeros((1, SIZE))
    whole, side, found = smooth, 1, True
    while found:
        merged, found = np.zeros((rows, columns), np.bool_), False
        for i in range(0, rows - 2 * side + 1, 2 * side):
            for j in range(0, columns - 2 * side + 1, 2 * side):
                u, v = i + side, j + side
                if not (whole[i, j] and whole[i, v] and whole[u, j] and whole[u, v]):
                    continue
                linked = True
                for k in range(2 * side):
                    linked &= right[i + k, v - 1] and below[u - 1, j + k]
                a, b = i * columns + j, i * columns + v
                c, d = u * columns + j, u * columns + v
                if not linked:
                    continue
                for entry in range(SIZE):
                    total[0, entry] = moments[a, entry] + moments[b, entry]
                    total[0, entry] += moments[c, entry] + moments[d, entry]
                together = fit(total, 0, theta)
                apart = residual[a] + residual[b] + residual[c] + residual[d]
                if total[0, COUNT] <= largest and together - apart < _CLEAR:
                    merged[i, j] = found = True
                    residual[a] = together
                    for entry in range(SIZE):
                        moments[a, entry] = total[0, entry]
                    # What has been merged before follows its own parent.
                    parent[b] = parent[c] = parent[d] = a
        whole, side = merged, 2 * side
    return parent


@njit(cache=True, error_model='numpy')
def _grow(
    moments: Floats,
    residual: Floats,
    chains: tuple[NDArray[np.uint32], ...],
    largest: float,
    block_inflation: float,
) -> NDArray[np.uint32]:
    """Merge parts to patches of at most `largest` pixels, the flattest first, each with the
    neighbour it fits best; in place.

    Of moments (N, 13) and residuals (N,); returns the root of each part's patch. The `chains` of
    merged patches join in constant time.
    """
    count, (head, tail, link, target) = len(moments), chains
    parent = np.empty(count, np.uint32)
    # Buckets of equally flat patches, each a queue: first in, first out.
    first, last = np.full(_LEVELS, _NONE), np.full(_LEVELS, _NONE)
    after = np.full(count, _NONE)
    for k in range(count):
        parent[k] = k
        _wait(parent[k], residual[k] / moments[k, COUNT], first, last, after)
    seen = np.full(count, _NONE)
    turn, level = np.uint32(0), 0
    while level < _LEVELS:
        a = first[level]
        if a == _NONE:
            level += 1
            continue
        first[level] = after[a]
        if parent[a] != a:
            continue
        turn += np.uint32(1)
        seen[a] = turn
        best, partner, together = 1.0, _NONE, 0.0
        before, e = _NONE, head[a]
        while e != _NONE:
            b = target[e]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            target[e] = b
            following = link[e]
            if seen[b] == turn:
                # An inner edge, or one more to the same patch.
                if before == _NONE:
                    head[a] = following
                else:
                    link[before] = following
                if following == _NONE:
                    tail[a] = before
            else:
                seen[b] = turn
                before = e
                if moments[a, COUNT] + moments[b, COUNT] <= largest:
                    common = common_residual(moments, int(np.intp(a)), int(np.intp(b)))
                    extra = common - residual[a] - residual[b]
                    apart = _misfit(extra, moments, a, b, block_inflation)
                    if apart < best:
                        best, partner, together = apart, b, common
            e = following
        if partner != _NONE:
            residual[a] = together
            for entry in range(SIZE):
                moments[a, entry] += moments[partner, entry]
            parent[partner] = a
            if head[partner] != _NONE:
                link[tail[a]] = head[partner]
                tail[a] = tail[partner]
            level = min(level, _wait(a, together / moments[a, COUNT], first, last, after))
    return find_roots(parent)


@njit(cache=True)
def _wait(
    a: np.uint32,
    residual: float,
    first: NDArray[np.uint32],
    last: NDArray[np.uint32],
    after: NDArray[np.uint32],
) -> int:
    """Append a patch of such a mean residual to the queue of its bucket; the bucket's number."""
    level = int(min(residual * _PER_VARIANCE, _LEVELS - 1.0))
    if first[level] == _NONE:
        first[level] = a
    else:
        after[last[level]] = a
    last[level], after[a] = a, _NONE
    return level
