"""Alpha-expansion on a pyramid: of all labels where it is coarse, then along borders only.

The energy is that of the pixels at every level (`pyramid`). At the two coarsest levels labels are
expanded over all of the image, at the others from the borders of their regions and from sites
that they suit much better than the labels there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.angles import UNIT, angle_table, cell_of, degrees, find_cells
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

# Sites of the coarsest level are 16 pixels wide: 1200 in VGA, of which every label is expanded in
# about as much time as all levels below take together. At the second, 64 angles fit in 16 bits.
_LEVELS = 4
_SECOND = 3
# The prior at the coarsest level, in those of the others: under the plain one, two directions
# often share a plane that is not quite flat.
_FIRST_PRIOR = 3
# A site may take a label that costs it no more than its share of the border around a region of so
# many sites across.
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
    nearest : (cells,) int32
        Label nearest to each cell of `angles.cell_of`.
    """

    normals: NDArray[np.float32]
    top: NDArray[np.uint8]
    vectors: NDArray[np.float32]
    nearest: NDArray[np.int32]


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
    vectors = np.ascontiguousarray(directions, np.float32)
    table, nearest = angle_table(vectors.tobytes(), len(vectors))
    pyramid = Pyramid.of(grid, smoothness, _LEVELS)
    normals = np.ascontiguousarray(normals, np.float32)
    observed = _Observed(normals, pyramid.top, vectors, nearest)
    costs = _label_costs(observed, pyramid, table)
    labels = None if before is None else _warm(before, costs, observed, pyramid)
    if labels is None:
        coarsest = _sum_members(costs, pyramid.members[_SECOND])
        labels = coarsest.argmin(axis=2).astype(np.int32)
        labelling = _labelling(labels, _LEVELS, observed, pyramid)
        labelling = labelling._replace(links=np.float32(_FIRST_PRIOR) * labelling.links)
        _expand_all(coarsest, labelling)
        labels = _handed_down(labels, _SECOND, observed, pyramid)
    _expand_all(costs, _labelling(labels, _SECOND, observed, pyramid))
    for level in range(_SECOND - 1, -1, -1):
        labels = _handed_down(labels, level, observed, pyramid)
        labelling = _labelling(labels, level, observed, pyramid)
        run_halves(_expand_near, len(labels), level, observed, labelling)
    return labels


def _label_costs(
    observed: _Observed, pyramid: Pyramid, table: NDArray[np.uint16]
) -> NDArray[np.uint16]:
    """Data costs (h, w, K) of every label at the second coarsest level, in `UNIT`."""
    cells = np.empty(observed.top.shape, np.int32)
    run_rows(find_cells, len(cells), observed.normals, cells)
    shape = pyramid.links[_SECOND].shape[1:]
    costs = np.zeros((*shape, len(observed.vectors)), np.uint16)
    run_rows(_sum_pixels, len(costs), cells, pyramid.top, table, costs)
    return costs


@njit(cache=True, nogil=True)
def _sum_pixels(
    first: int,
    after: int,
    cells: NDArray[np.int32],
    top: NDArray[np.uint8],
    table: NDArray[np.uint16],
    costs: NDArray[np.uint16],
) -> None:
    """Add what the pixels of some rows of sites cost."""
    for i in range(first << _SECOND, min(after << _SECOND, len(cells))):
        for j in range(cells.shape[1]):
            if top[i, j] >= _SECOND and cells[i, j] >= 0:
                row, sums = table[cells[i, j]], costs[i >> _SECOND, j >> _SECOND]
                for k in range(len(row)):
                    sums[k] += row[k]


@njit(cache=True, nogil=True)
def _sum_members(costs: NDArray[np.uint16], member: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Data costs (h, w, K) at the next level: those of its members together."""
    height, width, count = costs.shape
    result = np.zeros(((height + 1) // 2, (width + 1) // 2, count), np.uint32)
    for i in range(height):
        for j in range(width):
            if member[i, j]:
                row, sums = costs[i, j], result[i // 2, j // 2]
                for k in range(count):
                    sums[k] += row[k]
    return result


def _labelling(
    labels: NDArray[np.int32], level: int, observed: _Observed, pyramid: Pyramid
) -> GridLabelling:
    """Labels (h, w) of a level, which change in place, with what they cost."""
    data = np.empty(labels.shape, np.float32)
    run_rows(_sum_chosen, len(labels), labels, level, observed, data)
    links = pyramid.links[level].reshape(2, -1)
    return GridLabelling.of(labels.reshape(-1), data.ravel(), links, labels.shape[1])


def _warm(
    before: NDArray[np.integer],
    costs: NDArray[np.uint16],
    observed: _Observed,
    pyramid: Pyramid,
) -> NDArray[np.int32] | None:
    """Labels before (h, w) of the second coarsest level, where the data do not speak against them.

    That is where the best label saves more than half of the links of the site, as where something
    moved, and takes its place. None if the scene looks like another one.
    """
    best = costs.argmin(axis=2).astype(np.int32)
    rows, columns = (
        np.minimum((np.arange(count) << _SECOND) + (1 << _SECOND - 1), size - 1)
        for count, size in zip(best.shape, before.shape, strict=True)
    )
    labels = before[np.ix_(rows, columns)].astype(np.int32)
    labelling = _labelling(labels, _SECOND, observed, pyramid)
    lost = labelling.data - UNIT * costs.min(axis=2).ravel()
    half = _link_sums(labelling.links, labelling.width) / 2
    against = (lost > half).reshape(best.shape)
    if 2 * np.count_nonzero(against) > against.size:
        return None
    return np.where(against, best, labels)


def _handed_down(
    labels: NDArray[np.int32],
    level: int,
    observed: _Observed,
    pyramid: Pyramid,
) -> NDArray[np.int32]:
    """Labels (h, w) of a level from those of the next one.

    Sites that are no member of one there take the label of what they are linked to, or the one
    nearest to their normal where that has none either; any will do where neither is.
    """
    member = pyramid.members[level]
    height, width = member.shape
    finer = labels.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    result = np.where(member, finer, np.int32(-1))
    links = pyramid.links[level].reshape(2, -1)
    _spread(result.reshape(-1), links, width)
    _observe(result, level, observed)
    _spread(result.reshape(-1), links, width)
    return np.maximum(result, 0)


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
def _observe(labels: NDArray[np.int32], level: int, observed: _Observed) -> None:
    """Give sites (h, w) of -1 the label nearest to their normal; in place."""
    for a in range(labels.shape[0]):
        for b in range(labels.shape[1]):
            if labels[a, b] < 0:
                labels[a, b] = _nearest(a, b, level, observed)


@njit(cache=True, nogil=True)
def _nearest(a: int, b: int, level: int, observed: _Observed) -> int:
    """Label nearest to the mean normal of a site, -1 for none."""
    normals, top = observed.normals, observed.top
    x = y = z = np.float32(0)
    for i in range(a << level, min((a + 1) << level, len(top))):
        for j in range(b << level, min((b + 1) << level, top.shape[1])):
            if top[i, j] >= level and normals[i, j, 0] == normals[i, j, 0]:
                x += normals[i, j, 0]
                y += normals[i, j, 1]
                z += normals[i, j, 2]
    cell = cell_of(x, y, z)
    return observed.nearest[cell] if cell >= 0 else -1


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


@njit(cache=True, nogil=True)
def _link_sums(links: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Sum (n,) over the links of each site."""
    total = links[0] + links[1]
    total[1:] += links[0, :-1]
    total[width:] += links[1, :-width]
    return total


def _expand_all(costs: NDArray[np.unsignedinteger], labelling: GridLabelling) -> None:
    """Expand the best label of every site over all of a level, given all costs (h, w, K)."""
    tried = np.unique(costs.argmin(axis=2))
    _expand_each(
        tried, np.ascontiguousarray(costs[..., tried].reshape(-1, len(tried)).T), labelling
    )


@njit(cache=True, nogil=True)
def _expand_each(
    tried: NDArray[np.intp], costs: NDArray[np.unsignedinteger], labelling: GridLabelling
) -> None:
    """Expand labels (t,) once, given what they cost (t, n); in place."""
    labels, data, position = labelling.labels, labelling.data, labelling.position
    bearable = _link_sums(labelling.links, labelling.width) / np.float32(_REGION)
    sites, new = np.empty(len(labels), np.int32), np.empty(len(labels), np.float32)
    for t in range(len(tried)):
        count = 0
        for p in range(len(labels)):
            cost = UNIT * np.float32(costs[t, p])
            if labels[p] != tried[t] and cost - data[p] < bearable[p]:
                sites[count], new[count], position[p] = p, cost, count
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
    width, data = labelling.width, labelling.data
    first, after = rows[0] * width, rows[1] * width
    sites, suits = np.empty(after - first, np.int32), np.empty(after - first, np.int32)
    share = _link_sums(labelling.links, width) / np.float32(_REGION)
    found = 0
    for p in range(first, after):
        if level > 0 and data[p] > share[p]:
            label = _nearest(p // width, p % width, level, observed)
            cost = _cost(p // width, p % width, label, level, observed)
            if data[p] - cost > share[p]:
                sites[found], suits[found] = p, label
                found += 1
    return group_sites(suits[:found], sites[:found], len(observed.vectors))
