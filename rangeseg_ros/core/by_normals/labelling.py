"""Minimisation of the energy of method normals (thesis eq. 5.3 and 5.5), coarse to fine.

A site is a square of `size` x `size` pixels, numbered in raster order. It costs the sum of the
angles between the normals of its pixels and its direction, in degrees. A pixel without normal
(NaN) costs nothing, so that its neighbours decide (thesis 6.7).

Squares are expanded first, then the pixels near the borders of their labels. A square stands for
its largest part that no jump edge cuts. Its data cost and its links to other squares are the sums
of those of the part's pixels, so that its energy is theirs. Squares begin with the direction
nearest to their mean normal, pixels with the label of their square. Each label is expanded from
its borders, as far as it gains (thesis 4.8).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Ints, Mask, Singles
from rangeseg_ros.core.graphcut import expansion
from rangeseg_ros.core.graphcut.expansion import (
    ROUNDING,
    GridLabelling,
    band,
    beyond,
    expand,
    fronts,
    link_costs,
)
from rangeseg_ros.core.regions import connected_components
from rangeseg_ros.core.runtime.threads import run_halves
from rangeseg_ros.core.sensing.enlargement import Cells
from rangeseg_ros.core.sensing.grid import Grid

# Pixels along a side of a square, 4800 squares in VGA, and sites from a border to expand it to.
_SIZE = 8
_SQUARES = Cells(_SIZE, 0, 0)


def minimise(normals: Singles, directions: Singles, grid: Grid, smoothness: float) -> Ints:
    """Labelling (H, W) of low energy (eq. 5.3 and 5.5, lambda = `smoothness`).

    Labels are indices of directions (K, 3); normals (H, W, 3) are NaN where undefined.
    """
    height, width = normals.shape[:2]
    links, inside = link_costs(grid, smoothness).reshape(2, height, width), _largest_parts(grid)
    known = np.where(inside[..., None], normals, np.float32(np.nan))
    squares = _nearest(known, directions, _SIZE)
    for _ in range(2):
        _expand(squares, _SIZE, _between_squares(links, inside), known, directions)
    labels = _SQUARES.enlarged(squares, (height, width)).copy()
    _expand(labels, 1, links, normals, directions)
    return labels


def minimise_exactly(normals: Singles, directions: Singles, grid: Grid, smoothness: float) -> Ints:
    """What `minimise` finds, from the nearest direction at every pixel on.

    No expansion of a label over the image improves it (thesis 4.8).
    """

    def cost(label: int, pixels: Ints) -> Singles:
        return label_costs(label, pixels, 1, normals, directions)

    labels = _nearest(normals, directions, 1)
    data = data_costs(labels, 1, normals, directions).ravel()
    links = link_costs(grid, smoothness)
    labelling = GridLabelling.of(labels.ravel(), data, links, labels.shape[1])
    expansion.minimise(labelling, len(directions), cost)
    return labels


@njit(cache=True, nogil=True)
def _nearest_directions(normals: Singles, directions: Singles) -> Ints:
    """Direction (K, 3) nearest to each normal (h, w, 3), of any length: (h, w) index, else 0."""
    labels = np.zeros(normals.shape[:2], np.int32)
    for i in range(len(labels)):
        for j in range(labels.shape[1]):
            x, y, z = normals[i, j]
            most = np.float32(-np.inf)
            for k in range(len(directions)):
                along = x * directions[k, 0] + y * directions[k, 1] + z * directions[k, 2]
                if along > most:
                    labels[i, j], most = k, along
    return labels


def _nearest(normals: Singles, directions: Singles, size: int) -> Ints:
    """Direction nearest to the mean of each square's normals."""
    return _nearest_directions(_per_square(np.add, np.nan_to_num(normals), size), directions)


def _largest_parts(grid: Grid) -> Mask:
    """Pixels (H, W) in the largest connected part of their square."""
    shape = len(grid.right), grid.below.shape[1]
    rows, columns = (-(-length // _SIZE) for length in shape)
    squares = _SQUARES.enlarged(np.arange(rows * columns).reshape(rows, columns), shape)
    parts = connected_components(squares, grid, np.ones(shape, np.bool_))
    # By size; of parts as large, the last one.
    rank = np.bincount(parts.ravel())[parts] * (parts.max() + 1) + parts
    inside: Mask = rank == _SQUARES.enlarged(_per_square(np.maximum, rank, _SIZE), shape)
    return inside


def _between_squares(links: Singles, inside: Mask) -> Singles:
    """Links (2, h, w) of the squares, sums of those (2, H, W) between pixels `inside` (H, W)."""
    right, below = np.zeros_like(links)
    last, next_ = slice(_SIZE - 1, -1, _SIZE), slice(_SIZE, None, _SIZE)
    right[:, last] = links[0, :, last] * (inside[:, last] & inside[:, next_])
    below[last] = links[1, last] * (inside[last] & inside[next_])
    return np.stack([_per_square(np.add, right, _SIZE), _per_square(np.add, below, _SIZE)])


def _per_square(function: np.ufunc, values: NDArray[Any], size: int) -> NDArray[Any]:
    """Reduce the values (H, W, ...) of each square's pixels to one, (h, w, ...)."""
    for axis in (0, 1):
        values = function.reduceat(values, np.arange(0, values.shape[axis], size), axis=axis)
    return values


def _expand(
    labels: Ints, size: int, links: Singles, normals: Singles, directions: Singles
) -> None:
    """Expand the labels (h, w) of sites of `size` x `size` pixels; in place."""
    height, width = labels.shape
    data = data_costs(labels, size, normals, directions)
    labelling = GridLabelling.of(labels.ravel(), data.ravel(), links.reshape(2, -1), width)
    run_halves(_expand_rows, height, labelling, size, normals, directions)


@njit(cache=True, nogil=True)
def _expand_rows(
    rows: tuple[int, int],
    labelling: GridLabelling,
    size: int,
    normals: Singles,
    directions: Singles,
) -> None:
    """Expand every label in some rows from its borders, as far as it gains; in place."""
    start, sites = fronts(labelling, len(directions), rows)
    for alpha in range(len(directions)):
        front = sites[start[alpha] : start[alpha + 1]]
        while len(front) > 0:
            near = band(alpha, front, _SIZE, labelling, rows)
            costs = label_costs(alpha, near, size, normals, directions)
            if not expand(alpha, near, costs, labelling, ROUNDING):
                break
            front = beyond(alpha, near, labelling, rows)


@njit(cache=True, nogil=True)
def data_costs(labels: Ints, size: int, normals: Singles, directions: Singles) -> Singles:
    """Cost (h, w) of every site's own label, of normals (H, W, 3) and directions (K, 3)."""
    costs = np.empty(labels.shape, np.float32)
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            costs[i, j] = _cost(directions[labels[i, j]], i, j, size, normals)
    return costs


@njit(cache=True, nogil=True)
def label_costs(
    label: int, sites: NDArray[np.integer], size: int, normals: Singles, directions: Singles
) -> Singles:
    """Cost (s,) of one label at sites (s,); the rest as of `data_costs`."""
    width = -(-normals.shape[1] // size)
    costs = np.empty(len(sites), np.float32)
    for s in range(len(sites)):
        row, column = sites[s] // width, sites[s] % width
        costs[s] = _cost(directions[label], row, column, size, normals)
    return costs


@njit(cache=True, inline='always')
def _cost(direction: Singles, row: int, column: int, size: int, normals: Singles) -> np.float32:
    height, width = normals.shape[:2]
    a, b, c = direction
    total = np.float32(0)
    for i in range(row * size, min((row + 1) * size, height)):
        for j in range(column * size, min((column + 1) * size, width)):
            normal = normals[i, j]
            total += degrees(a * normal[0] + b * normal[1] + c * normal[2])
    return total


@njit(cache=True, inline='always')
def degrees(cosine: np.float32) -> np.float32:
    """Arc cosine in degrees, 0 for NaN; Abramowitz and Stegun 4.4.46, to 2e-8 rad.

    Without branches and calls, so that the compiler can make eight at a time.
    """
    x = min(abs(cosine), np.float32(1))
    p = np.float32(-0.0012624911)
    p = p * x + np.float32(0.0066700901)
    p = p * x + np.float32(-0.0170881256)
    p = p * x + np.float32(0.0308918810)
    p = p * x + np.float32(-0.0501743046)
    p = p * x + np.float32(0.0889789874)
    p = p * x + np.float32(-0.2145988016)
    p = p * x + np.float32(1.5707963050)
    p = p * np.sqrt(np.float32(1) - x) * np.float32(180 / np.pi)
    p = p if cosine >= 0 else np.float32(180) - p
    return p if cosine == cosine else np.float32(0)
