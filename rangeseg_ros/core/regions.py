"""Regions of a labelling: connected components (thesis 3.1.1) large enough for planes (5.10)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Indices, Ints, Labels, Mask
from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.sensing.grid import Grid


def least_pixels(min_pixels: int, shape: tuple[int, int]) -> int:
    """Pixels of the smallest plane: `min_pixels`, or for 0 what follows the size of the image.

    300 of VGA are a face of 17 x 17 pixels, 1.7 degrees wide for most cameras.
    """
    return min_pixels or max(round(300 * shape[0] * shape[1] / VGA), 1)


def plane_regions(labels: NDArray[np.integer], valid: Mask, grid: Grid, min_pixels: int) -> Labels:
    """Segmentation (H, W) of a labelling: its components that are large enough for planes.

    1...M by falling size, 0 for no plane: pixels that are not valid, and regions of less than
    `min_pixels`.
    """
    components = connected_components(labels, grid, valid)
    area = region_sizes(components, int(components.max()) + 1)
    area[0] = 0
    return relabel(components, by_falling_size(np.where(area < min_pixels, 0, area)))


@njit(cache=True, nogil=True)
def connected_components(labels: NDArray[np.integer], grid: Grid, valid: Mask) -> Ints:
    """4-connected components of like labels that cross no disconnected edge.

    Their numbers (H, W), 1...M, 0 where not valid: by two passes, with a table of equivalent
    numbers between them (thesis 3.1.1).
    """
    (height, width), (right, below) = labels.shape, grid
    found = np.zeros((height, width), np.int32)
    # Union-find: parent[k] is a lower number of the same component, or k itself.
    parent = np.empty(labels.size + 1, np.int32)
    count = 0
    for i in range(height):
        for j in range(width):
            if not valid[i, j]:
                continue
            here = labels[i, j]
            if j > 0 and right[i, j - 1] and labels[i, j - 1] == here:
                found[i, j] = found[i, j - 1]
            if i > 0 and below[i - 1, j] and labels[i - 1, j] == here:
                a, b = found[i, j], found[i - 1, j]
                if a == 0:
                    found[i, j] = b
                elif b > 0 and a != b:
                    while parent[a] != a:
                        a = parent[a]
                    while parent[b] != b:
                        b = parent[b]
                    parent[max(a, b)] = min(a, b)
            if found[i, j] == 0:
                count += 1
                parent[count] = found[i, j] = count
    number, last = np.zeros(count + 1, np.int32), 0
    for k in range(1, count + 1):
        last += parent[k] == k
        number[k] = last if parent[k] == k else number[parent[k]]
    return number[found.ravel()].reshape(labels.shape)


@njit(cache=True, nogil=True)
def region_sizes(regions: NDArray[np.integer], count: int) -> Indices:
    """Pixels (count,) of each region 0...count - 1."""
    sizes = np.zeros(count, np.intp)
    for i in range(len(regions)):
        # Count runs, not pixels: increments of one counter would wait for each other.
        last, begin = regions[i, 0], 0
        for j in range(regions.shape[1]):
            if regions[i, j] != last:
                sizes[last] += j - begin
                last, begin = regions[i, j], j
        sizes[last] += regions.shape[1] - begin
    return sizes


def numbers_of(kept: Mask) -> Labels:
    """New number of each region: 1, 2, ... of those of 1...M that are `kept` (M + 1,), else 0."""
    kept = kept & (np.arange(len(kept)) > 0)
    return np.where(kept, np.cumsum(kept), 0).astype(np.uint16)


def by_falling_size(area: NDArray[np.integer]) -> Labels:
    """New number of each region: 1...M by falling size, 0 for size 0; at most 65535."""
    order = (-area).argsort(kind='stable')[: min(np.count_nonzero(area), 65535)]
    table = np.zeros(len(area), np.uint16)
    table[order] = np.arange(1, len(order) + 1)
    return table


@njit(cache=True, nogil=True)
def relabel(regions: NDArray[np.integer], table: Labels) -> Labels:
    """Regions (H, W) by another name: `table` (M + 1,) has the new number of each."""
    renamed = np.empty(regions.shape, np.uint16)
    for i in range(len(regions)):
        for j in range(regions.shape[1]):
            renamed[i, j] = table[regions[i, j]]
    return renamed
