"""What the columns of cells tell, outwards from the robot: edges that the ground falls from."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import Cells
from rangeseg_ros.core.meaning.steps import Steps

# Cells along a column whose mean tells a level.
_MEAN = 4
# Columns most of which must agree: wider than the correlation of a stereo camera's noise, so that
# none of its patches does; and several times as wide, so that no few of them together do.
_BESIDE = (7, 21)


def below_edges(
    height: NDArray[np.float32],
    cells: Cells,
    steps: Steps,
    steep: NDArray[np.bool_],
    broken: NDArray[np.bool_],
    turned: bool,
    rise: bool = False,
) -> NDArray[np.bool_]:
    """Cells beyond an edge that the ground falls from, up to where it comes back by another one.

    A surface may pass the end of its edge, or a gap that noise makes in it: what most of the
    columns around show has fallen.

    Parameters
    ----------
    height : (rows, columns) float32
        Above a plane, metres; NaN where not measured.
    cells : Cells
    steps : Steps
    steep, broken : (rows, columns) bool
        See `Surfaces`.
    turned : bool
        Whether up is down along the columns.
    rise : bool
        The same where the ground rises.
    """
    signed = -height if rise else height
    fallen, before = _fallen(signed, cells.place, steps, steep, broken, turned, rise)
    most = _most(fallen)
    _close_gaps(most, signed, before, steps.least, turned, rise)
    if not rise:
        _spread(most, signed, before, steps)
    return most


@njit(cache=True, nogil=True)
def _most(fallen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where most of the columns around have fallen, mirrored at the borders of the image."""
    rows, columns = fallen.shape
    reach = _BESIDE[1] // 2
    column = np.zeros(columns + 2 * reach, np.int64)
    for k in range(len(column)):
        c = abs(k - reach)
        while columns > 1 and not 0 <= c < columns:
            c = 2 * (columns - 1) - c if c >= columns else -c
        column[k] = min(c, columns - 1)
    result = np.zeros((rows, columns), np.bool_)
    # How many have fallen up to a column.
    number = np.zeros(len(column) + 1, np.int64)
    for i in range(rows):
        for k in range(len(column)):
            number[k + 1] = number[k] + fallen[i, column[k]]
        if number[-1] == 0:
            continue
        for width in _BESIDE:
            half = width // 2
            for c in range(columns):
                around = number[c + reach + half + 1] - number[c + reach - half]
                result[i, c] |= around > half
    return result


@njit(cache=True, nogil=True, error_model='numpy')
def _close_gaps(
    fallen: NDArray[np.bool_],
    height: NDArray[np.float32],
    before: NDArray[np.float32],
    least: float,
    turned: bool,
    rise: bool,
) -> None:
    """Let what lies between `fallen` columns have fallen as well, from where it lies as low.

    Something may hide an edge in more columns than there are on either side to outvote them, and
    at the border of the image there is but one side, of which so many must have fallen that no few
    patches of noise tell it; a rise there hides nothing to fall into. What is as high as the
    ground before the edge beside it, such as a plank, is left. All are (rows, columns), `height`
    and that of the ground `before` in metres.
    """
    rows, columns = fallen.shape
    wide = _BESIDE[1]
    for m in range(rows):  # outwards
        i = m if turned else rows - 1 - m
        nearer = max(m - 1, 0) if turned else min(i + 1, rows - 1)
        last = columns if rise else -1
        for c in range(columns + (not rise)):
            if c < columns and not fallen[i, c]:
                continue
            gap = c - last - 1
            if 0 < gap <= wide:
                # At the border, the far edge of a trench aslant makes a gap as well.
                within = last >= 0 and c < columns
                closed = within and 2 * fallen[nearer, last + 1 : c].sum() > gap
                told = within or fallen[i, max(last + 1 - wide, 0) : c + wide].sum() == wide
                if closed or (told and _depth(height, before, i, last, c) > least):
                    fallen[i, last + 1 : c] = True
            last = c


@njit(cache=True, nogil=True)
def _spread(
    fallen: NDArray[np.bool_],
    height: NDArray[np.float32],
    before: NDArray[np.float32],
    steps: Steps,
) -> None:
    """Let what lies as low between `fallen` cells and a rise beside them have fallen as well.

    Columns cross an edge along the view late, or never. All are (rows, columns), `height` above
    the ground under the robot and that of the ground `before` in metres.
    """
    rows, columns = fallen.shape
    for i in range(rows):
        if not fallen[i].any():
            continue
        for side in (1, -1):
            first = columns if side < 0 else -1  # the last cell that has fallen
            level = np.nan
            for m in range(columns):
                c = m if side > 0 else columns - 1 - m
                if fallen[i, c]:
                    if before[i, c] == before[i, c]:
                        level = min(before[i, c], 0.0)
                    first = c
                elif not (level - height[i, c] > steps.least and abs(c - first) <= _BESIDE[0]):
                    rise = height[i, c] - height[i, c - side]
                    if level == level and rise > steps.beside:
                        for k in range(first + side, c, side):
                            fallen[i, k] = True
                    level = np.nan


@njit(cache=True, nogil=True, error_model='numpy')
def _depth(
    height: NDArray[np.float32], before: NDArray[np.float32], i: int, last: int, c: int
) -> float:
    """Depth of what lies between two columns of row i below the ground before the edges beside it.

    Metres; NaN where either was not measured.
    """
    level = low = 0.0
    known = seen = 0
    for k in range(max(last - _BESIDE[1], 0), min(c + _BESIDE[1] + 1, height.shape[1])):
        if before[i, k] == before[i, k]:
            level += before[i, k]
            known += 1
        if last < k < c and height[i, k] == height[i, k]:
            low += height[i, k]
            seen += 1
    return level / known - low / seen


@njit(cache=True, nogil=True, error_model='numpy')
def _fallen(
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    steps: Steps,
    steep: NDArray[np.bool_],
    broken: NDArray[np.bool_],
    turned: bool,
    rise: bool,
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """The same of each column by itself, of heights that fall; `rise` if they are those of a rise.

    And the mean height of the ground before, NaN for cells that have not fallen.

    How far the mean of the ground before lags behind counts for a ramp up alone: one down is a
    drop in doubt.
    """
    rows, columns = height.shape
    result = np.zeros((rows, columns), np.bool_)
    before_edge = np.full((rows, columns), np.float32(np.nan))
    # Of each column: mean height of the ground before, where that is, or its last cell, whether an
    # edge was passed since, and whether it has fallen.
    near, (x, y) = np.full(columns, np.nan), np.zeros((2, columns))
    edge, fallen, level = np.zeros((3, columns), np.bool_)
    for m in range(rows):  # outwards
        i = m if turned else rows - 1 - m
        # Between these cells and those before; the first cells have none before them.
        before = max(i if not turned else i - 1, 0)
        beyond = False
        # As vector instructions, and what is rare by itself.
        for c in range(columns):
            edge[c] |= broken[before, c] | steep[i, c]
            level[c] = (height[i, c] == height[i, c]) & ~steep[i, c]
            beyond |= edge[c] & level[c]
        for c in range(columns if beyond else 0):
            if edge[c] and level[c]:
                far, ramp = _beyond(m, c, height, place, steps, steep, turned, fallen[c], x, y)
                fallen[c] = near[c] - far > steps.least + ramp
                edge[c] = False
        for c in range(columns):
            result[i, c] = fallen[c] & level[c]
            before_edge[i, c] = np.float32(near[c]) if result[i, c] else np.float32(np.nan)
            first = near[c] != near[c]
            share = 1.0 if first or not rise else 1.0 / _MEAN
            own = height[i, c] if first else near[c] + (height[i, c] - near[c]) / _MEAN
            ahead, aside = (
                x[c] + (place[1, i, c] - x[c]) * share,
                y[c] + (place[2, i, c] - y[c]) * share,
            )
            goes_on = level[c] & ~fallen[c]
            near[c] = own if goes_on else near[c]
            x[c] = ahead if goes_on else x[c]
            y[c] = aside if goes_on else y[c]
    return result, before_edge


@njit(cache=True, nogil=True, error_model='numpy')
def _beyond(
    m: int,
    c: int,
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    steps: Steps,
    steep: NDArray[np.bool_],
    turned: bool,
    fallen: bool,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> tuple[float, float]:
    """Mean height from row m of column c outwards, and what of its fall a ramp may explain.

    Ten parameters: what `_fallen` knows where it finds an edge.
    """
    rows = len(height)
    # Sums of height and place beyond the edge, and farther away.
    total = np.zeros((2, 4))
    n = m
    while total[1, 0] < 3 * _MEAN and n < rows:
        k = n if turned else rows - 1 - n
        if not (np.isnan(height[k, c]) or steep[k, c]):
            part = total[int(total[0, 0] >= _MEAN)]
            part[0] += 1
            part[1] += height[k, c]
            part[2] += place[1, k, c]
            part[3] += place[2, k, c]
        n += 1
    _, far, p, q = total[0] / total[0, 0]
    if fallen:  # it takes more than a patch of noise to come back
        return (total[0, 1] + total[1, 1]) / (total[0, 0] + total[1, 0]), 0.0
    if total[1, 0] == 0:
        return far, 0.0
    # A ramp that hides behind its edge falls on.
    _, farther, v, w = total[1] / total[1, 0]
    fall = (far - farther) / np.sqrt((v - p) * (v - p) + (w - q) * (w - q))
    ramp = min(max(fall, 0.0), steps.slope)
    return far, ramp * np.sqrt((p - x[c]) * (p - x[c]) + (q - y[c]) * (q - y[c]))
