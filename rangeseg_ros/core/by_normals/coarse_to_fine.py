"""Alpha-expansion of cells of pixels, then of the pixels near their borders.

A cell is the largest connected part of a square of pixels; where a jump edge cuts the square, the
rest is left to the pixels. A cell's data costs and links are the sums of those of its pixels, and
so its energy is theirs. Cells begin with the label nearest to their mean normal, and these labels
are expanded over all cells. Pixels begin with the labels of the cells, which are expanded near
borders.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_normals.angles import degrees
from rangeseg_ros.core.graphcut.cut import ROUNDING
from rangeseg_ros.core.graphcut.energy import link_costs
from rangeseg_ros.core.graphcut.expansion import expand
from rangeseg_ros.core.graphcut.sites import GridLabelling, band, beyond, fronts, group_sites
from rangeseg_ros.core.regions import connected_components
from rangeseg_ros.core.runtime.threads import run_halves, run_rows
from rangeseg_ros.core.sensing.grid import Grid

# Pixels along a side of a cell, 4800 cells in VGA, and from a border that a label is expanded to.
_CELL = 8
_SMALL = _CELL // 2
# Cells across the smallest region that the prior is to leave.
_REGION = 6


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
    height, width = normals.shape[:2]
    normals, directions = (np.ascontiguousarray(a, np.float32) for a in (normals, directions))
    links, inside = link_costs(grid, smoothness), _largest_parts(grid)
    cells = _label_cells(normals, directions, links.reshape(2, height, width), inside)
    labels = np.where(inside, _enlarged(cells, _CELL, inside.shape), np.int32(-1)).ravel()
    normals = normals.reshape(-1, 3)
    _fill_in(labels, normals, directions, links, width)
    data = np.empty(labels.shape, np.float32)
    run_rows(_find_costs, len(labels), labels, normals, directions, data)
    labelling = GridLabelling.of(labels, data, links, width)
    suited = _suited(normals.reshape(height, width, 3), directions, data, smoothness)
    run_halves(_expand_near, height, normals, directions, suited, labelling)
    return labels.reshape(height, width)


def _largest_parts(grid: Grid) -> NDArray[np.bool_]:
    """Pixels (H, W) in the largest connected part of their square."""
    height, width = len(grid.right), grid.below.shape[1]
    rows, columns = np.arange(height)[:, None] // _CELL, np.arange(width) // _CELL
    squares = rows * (columns[-1] + 1) + columns
    parts = connected_components(squares, grid, np.ones((height, width), np.bool_))
    square = np.zeros(parts.max() + 1, np.intp)
    square[parts] = squares
    # Of equal ones the first.
    size = np.bincount(parts.ravel()) * len(square) - np.arange(len(square))
    most = np.zeros(squares.max() + 1, np.intp)
    np.maximum.at(most, square, size)
    return (size == most[square])[parts]


def _label_cells(
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    links: NDArray[np.float32],
    inside: NDArray[np.bool_],
) -> NDArray[np.int32]:
    """Labels (h, w) of the cells, given normals, links (2, H, W) and their pixels `inside`."""
    right, below = links
    right = right[:, _CELL - 1 : -1 : _CELL] * (
        inside[:, _CELL - 1 : -1 : _CELL] & inside[:, _CELL::_CELL]
    )
    below = below[_CELL - 1 : -1 : _CELL] * (inside[_CELL - 1 : -1 : _CELL] & inside[_CELL::_CELL])
    known = inside & ~np.isnan(normals[..., 0])
    mean = _square_sums(np.where(known[..., None], normals, np.float32(0)), _CELL)
    height, width = mean.shape[:2]
    sums = np.zeros((2, height, width), np.float32)
    sums[0, :, :-1] = np.add.reduceat(right, np.arange(0, len(right), _CELL), axis=0)
    sums[1, :-1] = np.add.reduceat(below, np.arange(0, below.shape[1], _CELL), axis=1)
    linked = sums.reshape(2, -1)
    labels = np.full(height * width, -1, np.int32)
    _fill_in(labels, mean.reshape(-1, 3), directions, linked, width)
    # What it costs to give a cell each of the labels that there are.
    tried, chosen = np.unique(labels, return_inverse=True)
    costs = np.zeros((height, width, len(tried)), np.float32)
    vectors = np.ascontiguousarray(directions[tried].T)
    run_rows(_sum_angles, height, normals, known, vectors, costs)
    costs = np.ascontiguousarray(costs.reshape(-1, len(tried)).T)
    data = costs[chosen, np.arange(len(labels))]
    _expand_each(tried, costs, GridLabelling.of(labels, data, linked, width))
    return labels.reshape(height, width)


def _suited(
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    data: NDArray[np.float32],
    smoothness: float,
) -> NDArray[np.int32]:
    """Labels (n,) that cost pixels much less than theirs, `data`, -1 where there is none.

    Those nearest to the mean normal of smaller squares, as a cell may hold several surfaces.
    """
    shape = normals.shape[:2]
    # The share in the border around the smallest region, half as many of them across.
    least = 4 * _SMALL * smoothness / (_REGION // 2)
    labels = np.where(_square_sums(data.reshape(shape), _SMALL) > least, np.int32(-1), np.int32(0))
    mean = _square_sums(np.nan_to_num(normals), _SMALL).reshape(-1, 3)
    run_rows(_choose_nearest, labels.size, labels.reshape(-1), mean, directions)
    found = _enlarged(np.maximum(labels, 0), _SMALL, shape).ravel()
    costs = np.empty(data.shape, np.float32)
    run_rows(_find_costs, len(data), found, normals.reshape(-1, 3), directions, costs)
    gain = _square_sums((data - costs).reshape(shape), _SMALL)
    return np.where(_enlarged(gain > least, _SMALL, shape).ravel(), found, np.int32(-1))


def _square_sums(values: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Sums (h, w, ...) over squares of an image (H, W, ...)."""
    for axis in (0, 1):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], size), axis=axis)
    return values


def _enlarged(squares: NDArray[Any], size: int, shape: tuple[int, int]) -> NDArray[Any]:
    """Values (h, w) of the squares for their pixels (H, W)."""
    return squares.repeat(size, axis=0).repeat(size, axis=1)[: shape[0], : shape[1]]


def _fill_in(
    labels: NDArray[np.int32],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    links: NDArray[np.float32],
    width: int,
) -> None:
    """Give sites (n,) of -1 the label of what they are linked to, else that of their normal.

    In place; any will do where neither is.
    """
    _spread(labels, links, width)
    run_rows(_choose_nearest, len(labels), labels, normals, directions)
    _spread(labels, links, width)
    np.maximum(labels, 0, out=labels)


@njit(cache=True, nogil=True)
def _spread(labels: NDArray[np.int32], links: NDArray[np.float32], width: int) -> None:
    """Give sites (n,) of -1 the label of the nearest site that is linked to them; in place."""
    offsets = np.array([1, width, -1, -width])
    queue = np.empty(len(labels), np.int32)
    last = 0
    for p in range(len(labels)):
        if labels[p] >= 0:
            queue[last] = p
            last += 1
    done = 0
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
def _choose_nearest(
    first: int,
    after: int,
    labels: NDArray[np.int32],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
) -> None:
    """Give some sites of -1 the label nearest to their normal, if they have one; in place."""
    for p in range(first, after):
        x, y, z = normals[p]
        most = np.float32(0)
        for k in range(len(directions) if labels[p] < 0 else 0):
            along = x * directions[k, 0] + y * directions[k, 1] + z * directions[k, 2]
            if along > most:
                labels[p], most = k, along


@njit(cache=True, nogil=True)
def _sum_angles(
    first: int,
    after: int,
    normals: NDArray[np.float32],
    known: NDArray[np.bool_],
    directions: NDArray[np.float32],
    costs: NDArray[np.float32],
) -> None:
    """Data costs (h, w, t) of directions (3, t) at some rows of cells, of `known` normals."""
    a, b, c = directions[0], directions[1], directions[2]
    for i in range(first * _CELL, min(after * _CELL, len(known))):
        for j in range(known.shape[1]):
            if known[i, j]:
                x, y, z = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
                sums = costs[i // _CELL, j // _CELL]
                for t in range(len(sums)):
                    sums[t] += degrees(a[t] * x + b[t] * y + c[t] * z)


@njit(cache=True, nogil=True)
def _expand_each(
    tried: NDArray[np.int32], costs: NDArray[np.float32], labelling: GridLabelling
) -> None:
    """Expand labels (t,) once, given what they cost (t, n); in place."""
    labels, data, position = labelling.labels, labelling.data, labelling.position
    links, width = labelling.links, labelling.width
    # What a label may cost a cell: its share in the border around a region.
    share = links[0] + links[1]
    share[1:] += links[0, :-1]
    share[width:] += links[1, :-width]
    share /= np.float32(_REGION)
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
def _find_costs(
    first: int,
    after: int,
    labels: NDArray[np.int32],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    data: NDArray[np.float32],
) -> None:
    """Data costs of the labels of some pixels."""
    for p in range(first, after):
        data[p] = _cost(normals[p], directions[labels[p]])


@njit(cache=True, inline='always')
def _cost(normal: NDArray[np.float32], direction: NDArray[np.float32]) -> np.float32:
    return degrees(normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2])


@njit(cache=True, nogil=True)
def _expand_near(
    rows: tuple[int, int],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    suited: NDArray[np.int32],
    labelling: GridLabelling,
) -> None:
    """Expand every label in some rows, as far as it gains; in place.

    From the borders of its regions and from the pixels that it suits.
    """
    width, count = labelling.width, len(directions)
    start, sites = fronts(labelling.labels, labelling.links, width, count, rows)
    first = rows[0] * width
    found = first + np.flatnonzero(suited[first : rows[1] * width] >= 0)
    begin, seeds = group_sites(suited[found], found.astype(np.int32), count)
    for alpha in range(count):
        borders = sites[start[alpha] : start[alpha + 1]]
        front = np.concatenate((borders, seeds[begin[alpha] : begin[alpha + 1]]))
        while len(front) > 0:
            near = band(alpha, front, _CELL, labelling, rows)
            new = np.empty(len(near), np.float32)
            for s in range(len(near)):
                new[s] = _cost(normals[near[s]], directions[alpha])
            if not expand(alpha, near, new, labelling, ROUNDING):
                break
            front = beyond(alpha, near, labelling, rows)
