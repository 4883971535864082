"""Connected components of a labelling, and how large they are (thesis 3.1.1, 5.10)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import map_halves, run_rows
from rangeseg_ros.core.sensing.grid import CHUNK, Grid
from rangeseg_ros.core.sensing.marks import no_marks


class Components(NamedTuple):
    """Connected components 1...M of an image.

    Attributes
    ----------
    most : int
        M.
    found : (H, W) int32
        A name of the component that each pixel is in; 0 for none.
    number : (N,) int32
        Component that each name stands for: some have several.
    """

    most: int
    found: NDArray[np.int32]
    number: NDArray[np.int32]

    def image(self) -> NDArray[np.int32]:
        """Component (H, W) of each pixel, 0 for none."""
        return self.number[self.found]

    def renamed(self, table: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Components (H, W) by another name: `table` (M + 1,) uint16 has the one of each."""
        result = np.empty(self.found.shape, np.uint16)
        run_rows(_rename, len(result), self.found, self.number, table, result)
        return result


def connected_components(
    labels: NDArray[np.integer],
    grid: Grid,
    valid: NDArray[np.bool_] | None = None,
) -> Components:
    """4-connected components of like labels that cross no disconnected edge.

    Parameters
    ----------
    labels : (H, W) int
    grid : Grid
    valid : (H, W) bool, optional
        Pixels to look at, all by default.
    """
    if valid is None:
        valid = np.ones(labels.shape, np.bool_)
    height, width = labels.shape
    found = np.empty((height, width), np.int32)
    parent = np.empty(height * width + 1, np.int32)
    counts = map_halves(_find_components, height, labels, grid, valid, found, parent)
    return Components(*_unite_halves(labels, grid, found, parent, *counts))


@njit(cache=True, nogil=True)
def _find_components(
    first: int,
    after: int,
    labels: NDArray[np.integer],
    grid: Grid,
    valid: NDArray[np.bool_],
    found: NDArray[np.int32],
    parent: NDArray[np.int32],
) -> int:
    """The first pass over some rows, with a table of equivalent labels (thesis 3.1.1).

    Numbers in `found` begin after that of the rows' first pixel; a number's `parent` is an
    equivalent, lower one, or itself. Returns how many there are.
    """
    width = labels.shape[1]
    start = first * width
    count = 0
    for i in range(first, after):
        # Views of the rows, of which the compiler takes many pixels at a time.
        above = max(i - 1, first)
        here, over = labels[i], labels[above]
        # An image of one row has no edges below, and none are asked for.
        between = min(above, len(grid.below) - 1)
        below = grid.below[between] if between >= 0 else grid.right[i]
        own, upper, right, measured = found[i], found[above], grid.right[i], valid[i]
        # What was last found equivalent: most pixels tell what the one before has told.
        known = -1
        for chunk in range(0, width, CHUNK):
            stop = min(chunk + CHUNK, width)
            if chunk > 0 and own[chunk - 1] > 0:
                label, number = here[chunk - 1], own[chunk - 1]
                a, b = here[chunk:stop], right[chunk - 1 : stop - 1]
                c, d, e = measured[chunk:stop], upper[chunk:stop], own[chunk:stop]
                alike = True
                for k in range(len(a)):
                    alike &= (a[k] == label) & (b[k] > 0) & c[k] & (d[k] == known)
                if alike:
                    for k in range(len(e)):
                        e[k] = number
                    continue
            for j in range(chunk, stop):
                if not measured[j]:
                    own[j] = 0
                    continue
                left = j > 0 and right[j - 1] > 0 and here[j - 1] == here[j] and own[j - 1] > 0
                up = i > first and below[j] > 0 and over[j] == here[j] and upper[j] > 0
                if left:
                    own[j] = own[j - 1]
                    if up and upper[j] != known:
                        known = upper[j]
                        _unite(int(own[j]), int(known), parent)
                elif up:
                    own[j] = known = upper[j]
                else:
                    known = -1
                    count += 1
                    parent[start + count] = start + count
                    own[j] = start + count
    return count


@njit(cache=True)
def _unite(a: int, b: int, parent: NDArray[np.int32]) -> None:
    while parent[a] != a:
        a = parent[a]
    while parent[b] != b:
        b = parent[b]
    parent[max(a, b)] = min(a, b)


@njit(cache=True, nogil=True)
def _unite_halves(
    labels: NDArray[np.integer],
    grid: Grid,
    found: NDArray[np.int32],
    parent: NDArray[np.int32],
    upper: int,
    lower: int,
) -> tuple[int, NDArray[np.int32], NDArray[np.int32]]:
    """Components, of which the halves of the rows have found so many."""
    height, width = labels.shape
    middle = height // 2
    if middle > 0:
        for j in range(width):
            a, b = int(found[middle - 1, j]), int(found[middle, j])
            alike = a > 0 and b > 0 and labels[middle - 1, j] == labels[middle, j]
            if alike and grid.below[middle - 1, j] > 0:
                _unite(a, b, parent)
    # A parent has a lower number than its children, so that one pass resolves and renumbers.
    number = np.empty(len(parent), np.int32)
    number[0] = last = 0
    for start, count in ((0, upper), (middle * width, lower)):
        for k in range(start + 1, start + count + 1):
            if parent[k] == k:
                last += 1
                number[k] = last
            else:
                number[k] = number[parent[k]]
    return last, found, number


@njit(cache=True, nogil=True)
def _rename(
    first: int,
    after: int,
    found: NDArray[np.int32],
    number: NDArray[np.int32],
    table: NDArray[np.uint16],
    result: NDArray[np.uint16],
) -> None:
    """What `Components.renamed` returns, of some rows."""
    for i in range(first, after):
        name, renamed = 0, table[0]
        for j in range(found.shape[1]):
            # Most pixels are called as the one before.
            if found[i, j] != name:
                name = found[i, j]
                renamed = table[number[name]]
            result[i, j] = renamed


def measures(components: Components) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number of pixels of each component, and of those that touch another or the border."""
    halves = map_halves(_counts, len(components.found), *components)
    (upper, upper_rim), (lower, lower_rim) = halves
    return upper + lower, upper_rim + lower_rim


@njit(cache=True, nogil=True)
def _counts(
    first: int, after: int, most: int, found: NDArray[np.int32], number: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """What `measures` returns, of some rows."""
    height, width = found.shape
    area, perimeter = np.zeros(most + 1, np.int64), np.zeros(most + 1, np.int64)
    # Components of three rows in turn: the one at hand, above and below it.
    rows = np.empty((3, width), np.int32)
    # With room for whole words, of which each tells of eight pixels whether there is a rim.
    rim = no_marks(width)
    eight = rim.view(np.uint64)
    for i in range(first, after):
        for k in range(i + 1 if i > first else max(i - 1, 0), min(i + 2, height)):
            for j in range(width):
                rows[k % 3, j] = number[found[k, j]]
        here = rows[i % 3]
        if i in (0, height - 1):
            rim[:width] = 1
        else:
            _find_rim(here, rows[(i - 1) % 3], rows[(i + 1) % 3], rim)
        for k in range(len(eight)):
            start, stop = 8 * k, min(8 * k + 8, width)
            if eight[k] == 0:
                area[here[start]] += stop - start
                continue
            for j in range(start, stop):
                area[here[j]] += 1
                perimeter[here[j]] += rim[j]
    return area, perimeter


@njit(cache=True, nogil=True)
def _find_rim(
    own: NDArray[np.int32],
    above: NDArray[np.int32],
    below: NDArray[np.int32],
    rim: NDArray[np.uint8],
) -> None:
    """Which pixels of a row touch another region, or the border at the sides."""
    # Views, of which the compiler takes many pixels at a time.
    here, left, right, inner = own[1:-1], own[:-2], own[2:], rim[1 : len(own) - 1]
    over, under = above[1:-1], below[1:-1]
    for j in range(len(here)):
        unlike = (here[j] != left[j]) | (here[j] != right[j])
        inner[j] = unlike | (here[j] != over[j]) | (here[j] != under[j])
    rim[0] = rim[len(own) - 1] = 1
