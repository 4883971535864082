"""Which parts of an image can be one ground: surfaces without a step and not too steep.

Along the columns and the rows, cells at several distances are compared: where the height changes
by more than the steepest ground would over the way between them, there is a step. What remains
hangs together or not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import Cells
from rangeseg_ros.core.meaning.steps import BASELINES, DIFFERENCE, GAP, Steps, is_step
from rangeseg_ros.core.runtime.threads import run_rows

# Rows of cells that an image must have for each row of a baseline: as a whole image has for the
# longest one, to the nearest power of two. Across a small one, it would span wall and floor.
_SPANNED = 240 / BASELINES[-1] / math.sqrt(2.0)
# Baselines of the noise between the halves of a cell, its neighbours, and the next but one.
_HALF, _NEXT, _SECOND = 1, 1, 2
_MEASURED, _BELOW, _BEYOND, _RIGHT = (np.uint8(bit) for bit in (1, 2, 4, 8))
"""Bits of links, see `join_cells`."""


class Surfaces(NamedTuple):
    """Surfaces that no step divides, and what divides them, (rows, columns).

    Attributes
    ----------
    label : (...) int32
        1...N, 0 for none.
    number : int
        N.
    steep : (...) bool
        Cells that lie in a step.
    broken : (...) bool
        Where a step is between a cell and the next measured one below.
    links : (...) uint8
        What else hangs together, see `join_cells`.
    """

    label: NDArray[np.int32]
    number: int
    steep: NDArray[np.bool_]
    broken: NDArray[np.bool_]
    links: NDArray[np.uint8]


def surfaces_of(cells: Cells, steps: Steps) -> Surfaces:
    """Surfaces of an image."""
    steep, broken = np.empty((2, *cells.error.shape), np.bool_)
    links = np.empty(cells.error.shape, np.uint8)
    run_rows(_divide, len(steep), cells, steps, steep, broken, links)
    # Noise hides parts of a step.
    closed = cv2.morphologyEx(steep.view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 7), np.uint8))
    steep = closed.view(np.bool_)
    return Surfaces(*join_cells(links, (~steep).view(np.uint8)), steep, broken, links)


@njit(cache=True, nogil=True)
def _divide(
    first: int,
    after: int,
    cells: Cells,
    steps: Steps,
    steep: NDArray[np.bool_],
    broken: NDArray[np.bool_],
    links: NDArray[np.uint8],
) -> None:
    """Rows first...after of what divides cells, and of what does not."""
    _mark(first, after, cells, steps, steep, broken)
    _link(first, after, cells, steps, broken, links)


@njit(cache=True, nogil=True)
def _mark(
    first: int,
    after: int,
    cells: Cells,
    steps: Steps,
    steep: NDArray[np.bool_],
    broken: NDArray[np.bool_],
) -> None:
    """Mark steps along the columns of cells."""
    place, error = cells.place, cells.error
    rows, columns = error.shape
    slope, factor = np.float32(steps.slope), np.float32(DIFFERENCE * steps.noise[_HALF])
    for i in range(first, after):
        for c in range(columns):
            bound = slope * cells.kink[1, i, c] + factor * error[i, c]
            steep[i, c] = cells.kink[0, i, c] > bound
            broken[i, c] = False
    # Rows before which the cells of a column lie in a step.
    within = np.empty(columns, np.int64)
    step = np.empty(columns, np.bool_)
    for b in range(len(BASELINES)):
        k = BASELINES[b]
        if k > 1 and k * _SPANNED > rows:
            break
        factor = np.float32(DIFFERENCE * steps.noise[b])
        # A step down, or along the view, is fatal where it is taken for a ramp; one up only hides.
        up, down = np.float32(steps.least), np.float32(steps.beside)
        if k > GAP:
            up = down = np.float32(np.inf)
        within[:] = 0
        last = 0
        # A step that begins in the rows before reaches into these.
        for i in range(max(first - k, 0), after):
            if i < last and i >= first:
                for c in range(columns):
                    if i < within[c]:
                        steep[i, c] = broken[i, c] = True
            if i + k >= rows:
                continue
            # No branch, so that the compiler makes them vector instructions.
            for c in range(columns):
                step[c] = is_step(place, error, factor, slope, up, down, i, c, i + k, c)
            for c in range(columns):
                if not step[c]:
                    continue
                # Between the two, and as far as the measurement goes where it ends there.
                end = i + k
                if i >= first:
                    broken[i, c] = True
                    if k > 1 and (i == 0 or np.isnan(place[0, i - 1, c])):
                        steep[i, c] = True
                if k > 1 and (end + 1 == rows or np.isnan(place[0, end + 1, c])):
                    end += 1
                within[c] = max(within[c], end)
                last = max(last, end)


@njit(cache=True, nogil=True)
def _link(
    first: int,
    after: int,
    cells: Cells,
    steps: Steps,
    broken: NDArray[np.bool_],
    links: NDArray[np.uint8],
) -> None:
    """What no step is between: see `join_cells`."""
    place, error = cells.place, cells.error
    rows, columns = error.shape
    slope, up, down = np.float32(steps.slope), np.float32(steps.least), np.float32(steps.beside)
    factors = (DIFFERENCE * steps.noise).astype(np.float32)
    # Whether a step is between a cell and the next, and the next but one.
    beside, across = np.zeros((2, columns), np.bool_)
    for i in range(first, after):
        # As vector instructions.
        for c in range(columns - 1):
            beside[c] = is_step(place, error, factors[_NEXT], slope, up, down, i, c, i, c + 1)
        for c in range(columns - 2):
            across[c] = is_step(place, error, factors[_SECOND], slope, up, down, i, c, i, c + 2)
        for c in range(columns):
            links[i, c] = 0
            if np.isnan(place[0, i, c]):
                continue
            link = np.uint8(0)
            if not broken[i, c] and i + 1 < rows:
                if not np.isnan(place[0, i + 1, c]):
                    link |= _BELOW
                # The next measured cell below.
                elif i + 2 < rows and not np.isnan(place[0, i + 2, c]):
                    apart = is_step(place, error, factors[0], slope, up, down, i, c, i + 2, c)
                    link |= np.uint8(0) if apart else _BEYOND
            # The one to the right, where the next but one agrees on either side.
            if c + 1 < columns and not np.isnan(place[0, i, c + 1]):
                apart = beside[c] or (c + 2 < columns and across[c]) or (c > 0 and across[c - 1])
                link |= np.uint8(0) if apart else _RIGHT
            links[i, c] = link | _MEASURED


@njit(cache=True, nogil=True)
def join_cells(links: NDArray[np.uint8], part: NDArray[np.uint8]) -> tuple[NDArray[np.int32], int]:
    """Surfaces of the linked cells of each part but 0, and their number.

    Parameters
    ----------
    links : (rows, columns) uint8
        Bits: whether it is measured; whether it hangs together with the one below, with the next
        but one below, across one that is not measured, with the one to the right.
    part : (rows, columns) uint8
        Cells of different parts do not hang together.
    """
    rows, columns = part.shape
    label = np.zeros((rows, columns), np.int32)
    parent = np.zeros(rows * columns + 1, np.int32)
    count = 0
    for i in range(rows):
        for c in range(columns):
            own = part[i, c]
            if own == 0 or links[i, c] == 0:
                continue
            found = 0
            if c > 0 and links[i, c - 1] & _RIGHT and part[i, c - 1] == own:
                found = label[i, c - 1]
            if i > 0 and part[i - 1, c] == own:
                other = 0
                if links[i - 1, c] & _BELOW:
                    other = label[i - 1, c]
                elif i > 1 and links[i - 2, c] & _BEYOND and part[i - 2, c] == own:
                    other = label[i - 2, c]
                if other > 0 and other != found:
                    found = other if found == 0 else _join(parent, found, other)
            if found == 0:
                count += 1
                found = parent[count] = count
            label[i, c] = found
    # Roots are the first of their surfaces: in the order of their first cells.
    number = np.zeros(count + 1, np.int32)
    surfaces = 0
    for k in range(1, count + 1):
        root = _find(parent, k)
        if root == k:
            surfaces += 1
            number[k] = surfaces
        else:
            number[k] = number[root]
    for i in range(rows):
        for c in range(columns):
            label[i, c] = number[label[i, c]]
    return label, surfaces


@njit(cache=True, nogil=True)
def _find(parent: NDArray[np.int32], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def _join(parent: NDArray[np.int32], i: int, k: int) -> int:
    """Their common root: the smaller one, so that it does not depend on the order."""
    a, b = _find(parent, i), _find(parent, k)
    first, other = min(a, b), max(a, b)
    parent[other] = first
    return first
