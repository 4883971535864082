"""Where regions end, and which others they touch there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.marks import no_marks

# Which neighbours of a pixel are of another region.
_RIGHT, _BELOW = 1, 2
# Of `Borders`.
_Fields = tuple[
    NDArray[np.intp],
    NDArray[np.intp],
    NDArray[np.intp],
    NDArray[np.intp],
    NDArray[np.intp],
    NDArray[np.intp],
]


class Borders(NamedTuple):
    """Borders of regions 0...M.

    Attributes
    ----------
    box : (M + 1, 4) int
        First row and column of each region, and the ones after its last; zeros without pixels,
        and for region 0.
    length : (M + 1,) int
        Sides of pixels where a region ends.
    start : (M + 2,) int
        Where the regions that each one touches begin in `other`; region 0 touches none.
    other : (N,) int
        The regions that touch region 1, 2, ..., those of each by rising number.
    links, cuts : (N,) int
        Edges of the grid that link the two, and those that a jump cuts.
    """

    box: NDArray[np.intp]
    length: NDArray[np.intp]
    start: NDArray[np.intp]
    other: NDArray[np.intp]
    links: NDArray[np.intp]
    cuts: NDArray[np.intp]

    def without(self, dropped: NDArray[np.bool_]) -> Borders:
        """Those of regions that are not `dropped` (M + 1,), never 0, numbered anew."""
        if not dropped.any():
            return self
        return Borders(*_without(self, dropped))


def find_borders(regions: NDArray[np.uint16], grid: Grid, count: int) -> Borders:
    """Borders of regions.

    Parameters
    ----------
    regions : (H, W) uint16
        0...M, 0 for none.
    grid : Grid
        (H, W), whose edges tell links from cuts.
    count : int
        M + 1.
    """
    return Borders(
        *_put_together(*map_halves(_find_stretches, len(regions), regions, grid, count))
    )


@njit(cache=True, nogil=True)
def _without(borders: Borders, dropped: NDArray[np.bool_]) -> _Fields:
    """What `Borders.without` returns where there is something to drop."""
    kept = ~dropped
    number, start = np.cumsum(kept) - 1, [0]
    left = np.zeros(len(borders.other), np.bool_)
    for k in np.flatnonzero(kept):
        for e in range(borders.start[k], borders.start[k + 1]):
            left[e] = kept[borders.other[e]]
        start.append(start[-1] + int(left[borders.start[k] : borders.start[k + 1]].sum()))
    touching = number[borders.other[left]], borders.links[left], borders.cuts[left]
    return borders.box[kept], borders.length[kept], np.array(start), *touching


@njit(cache=True, nogil=True)
def _find_stretches(
    first: int, after: int, regions: NDArray[np.uint16], grid: Grid, count: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Borders that some rows of pixels have to their right and below, and with the image's.

    Box and length of the regions as far as these tell them, and stretches (N, 4) of border, from
    either side: a region, one that it touches, links and cuts between the two.
    """
    height, width = regions.shape
    box, length = np.zeros((count, 4), np.intp), np.zeros(count, np.intp)
    box[:, 0], box[:, 1] = height, width
    # The stretch at hand of each region, to the right and below, as most pixels lead where the one
    # before does; and those that are over.
    hand = np.zeros((2, count, 3), np.intp)
    over = [(0, 0, 0, 0)]
    over.clear()
    # Each word tells of eight pixels whether there is a border.
    edge = no_marks(width)
    eight = edge.view(np.uint64)
    for i in range(first, after):
        row, below = regions[i], regions[min(i + 1, height - 1)]
        _find_edges(row, below, edge)
        _reach(box, length, 0, row[0], 1, 0)
        _reach(box, length, row[width - 1], 0, 1, width)
        for word in range(len(eight)):
            if eight[word] == 0:
                continue
            for j in range(8 * word, min(8 * word + 8, width)):
                k = int(row[j])
                if edge[j] & _RIGHT:
                    m = int(row[j + 1])
                    _reach(box, length, k, m, 1, j + 1)
                    if min(k, m) > 0:
                        _meet(hand[0], k, m, grid.right[i, j] > 0, over)
                if edge[j] & _BELOW:
                    m = int(below[j])
                    _reach(box, length, k, m, 0, i + 1)
                    if min(k, m) > 0:
                        _meet(hand[1], k, m, grid.below[i, j] > 0, over)
    for j in range(width):
        if first == 0:
            _reach(box, length, 0, regions[0, j], 0, 0)
        if after == height:
            _reach(box, length, regions[height - 1, j], 0, 0, height)
    for k in range(count):
        for axis in range(2):
            _end(hand[axis], k, over)
    stretches = np.empty((len(over), 4), np.intp)
    for e in range(len(over)):
        stretches[e, 0], stretches[e, 1], stretches[e, 2], stretches[e, 3] = over[e]
    return box, length, stretches


@njit(cache=True, nogil=True)
def _put_together(
    upper: tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]],
    lower: tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]],
) -> _Fields:
    """Of `Borders`, from what `_find_stretches` finds in the upper and in the lower rows."""
    box, length = upper[0].copy(), upper[1] + lower[1]
    for k in range(len(box)):
        for axis in range(2):
            box[k, axis] = min(box[k, axis], lower[0][k, axis])
            box[k, 2 + axis] = max(box[k, 2 + axis], lower[0][k, 2 + axis])
        if k == 0 or box[k, 2] == 0:
            box[k] = 0
    return box, length, *_summed(np.concatenate((upper[2], lower[2])), len(box))


@njit(cache=True, nogil=True)
def _find_edges(
    row: NDArray[np.uint16], below: NDArray[np.uint16], edge: NDArray[np.uint8]
) -> None:
    """Which neighbours of each pixel of a row are of another region."""
    # Views, of which the compiler takes many pixels at a time.
    right, last = row[1:], len(row) - 1
    for j in range(last):
        edge[j] = _RIGHT * (row[j] != right[j]) + _BELOW * (row[j] != below[j])
    edge[last] = _BELOW * (row[last] != below[last])


@njit(cache=True, inline='always')
def _reach(
    box: NDArray[np.intp], length: NDArray[np.intp], k: int, m: int, axis: int, after: int
) -> None:
    """Let region k end, and region m begin, before a row (axis 0) or column (axis 1)."""
    length[k] += 1
    length[m] += 1
    box[k, 2 + axis] = max(box[k, 2 + axis], after)
    box[m, axis] = min(box[m, axis], after)


@njit(cache=True, inline='always')
def _meet(
    hand: NDArray[np.intp], k: int, m: int, linked: bool, over: list[tuple[int, int, int, int]]
) -> None:
    """Add an edge between two regions to the stretch at hand, or begin another."""
    if hand[k, 0] != m:
        _end(hand, k, over)
        hand[k, 0], hand[k, 1], hand[k, 2] = m, 0, 0
    hand[k, 1] += linked
    hand[k, 2] += not linked


@njit(cache=True, inline='always')
def _end(hand: NDArray[np.intp], k: int, over: list[tuple[int, int, int, int]]) -> None:
    """Note the stretch of border at hand, if any, from both sides."""
    m, links, cuts = hand[k]
    if m > 0:
        over.append((k, m, links, cuts))
        over.append((m, k, links, cuts))


@njit(cache=True)
def _summed(
    stretches: NDArray[np.intp], count: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """What `Borders` has of the regions that touch."""
    one, two = stretches[:, 0], stretches[:, 1]
    order = _sorted(one, _sorted(two, np.arange(len(two)), count), count)
    start = np.zeros(count + 1, np.intp)
    other, links, cuts = np.zeros((3, len(two)), np.intp)
    last, before = -1, 0
    for e in order:
        if last < 0 or one[e] != one[before] or two[e] != two[before]:
            last += 1
            start[one[e] + 1] += 1
            other[last] = two[e]
        links[last] += stretches[e, 2]
        cuts[last] += stretches[e, 3]
        before = e
    return np.cumsum(start), other[: last + 1], links[: last + 1], cuts[: last + 1]


@njit(cache=True)
def _sorted(key: NDArray[np.intp], order: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Places `order` by rising keys below `count`; those of equal ones stay in order."""
    start = np.zeros(count + 1, np.intp)
    for e in order:
        start[key[e] + 1] += 1
    start = np.cumsum(start)
    result = np.empty_like(order)
    for e in order:
        result[start[key[e]]] = e
        start[key[e]] += 1
    return result
