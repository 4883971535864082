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
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance

BASELINES = (1, 2, 4, 8, 16)
"""Rows between cells that are compared; neighbours are as far apart as four rows or more."""
BROAD = 3
"""Baseline of the noise that cells of a patch share."""
# Baselines of the noise between the halves of a cell, its neighbours, and the next but one.
_HALF, _NEXT, _SECOND = 1, 1, 2
# Standard deviations of the noise that a step must exceed: one in 16 000 by chance.
_SIGNIFICANT = 4.0
# Cells without a measurement that a surface may reach across.
_GAP = 2


class Steps(NamedTuple):
    """What counts as a step.

    Attributes
    ----------
    slope : float
        Tangent of the steepest ground.
    least : float
        What the ground may differ by from where it is expected, metres.
    beside : float
        Height that the ground does not fall by between neighbours, metres.
    noise : (B,) float64
        See `noise_of`.
    """

    slope: float
    least: float
    beside: float
    noise: NDArray[np.float64]

    @classmethod
    def of(cls, slope: float, step: float, noise: NDArray[np.float64], blur: float) -> Steps:
        """What tells a step of the least height, metres, from ground.

        Half of it is not the same ground. Where the sensor smooths a step as a Gaussian kernel of
        a width of `blur` cells does, neighbours show a part of it.
        """
        shown = math.erf(_GAP / (2 * math.sqrt(2) * blur)) if blur > 0 else 1.0
        return cls(slope, step / 2, shown * step / 2, noise)


def noise_of(cells: Cells, sensor: SensorModel) -> NDArray[np.float64]:
    """What the cells of this image err by, relative to the sensor model, at each baseline.

    On a plane the inverse range is linear along a column, so that second differences are noise.
    Most cells lie on surfaces that are plane over these distances: the quantile 0.4 of what
    they show, as a standard deviation.

    Returns
    -------
    (B,) float64, one for each of `BASELINES`.
    """
    result: NDArray[np.float64] = _noise_of(cells.inverse, sensor)
    return result


@njit(cache=True, nogil=True)
def _noise_of(inverse: NDArray[np.float32], sensor: SensorModel) -> NDArray[np.float64]:
    rows, columns = inverse.shape
    found = np.ones(len(BASELINES))
    bends = np.empty(rows * columns)
    for b in range(len(BASELINES)):
        k, count = BASELINES[b], 0
        for i in range(k, rows - k, 2):
            for c in range(0, columns, 2):
                above, middle, below = inverse[i - k, c], inverse[i, c], inverse[i + k, c]
                if above > 0 and middle > 0 and below > 0:
                    bend = above - 2 * middle + below
                    bends[count] = bend * bend / random_variance(sensor, middle * middle)
                    count += 1
        if count:
            rank = int(0.4 * count)
            # Of a normal distribution, 40 % lie within 0.524 standard deviations.
            found[b] = np.sqrt(np.partition(bends[:count], rank)[rank] / 6) / 0.524
        elif b:
            found[b] = found[b - 1]
        # Never less than at shorter ones, nor than rounding makes.
        found[b] = max(found[b], found[b - 1] if b else 0.05)
    return found


def surfaces_of(
    cells: Cells, steps: Steps
) -> tuple[NDArray[np.int32], int, NDArray[np.bool_], NDArray[np.bool_]]:
    """Surfaces that no step divides.

    Returns
    -------
    surface : (rows, columns) int32
        1...N, 0 for none.
    count : int
        N.
    steep : (rows, columns) bool
        Cells that lie in a step.
    broken : (rows, columns) bool
        Where a step is between a cell and the next measured one below.
    """
    steep, broken = (np.zeros(cells.error.shape, np.bool_) for _ in range(2))
    run_rows(_mark, cells.error.shape[1], cells, steps, steep, broken)
    # Noise hides parts of a step.
    closed = cv2.morphologyEx(steep.view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 7), np.uint8))
    steep = closed.view(np.bool_)
    return *join_cells(cells, steps, steep, broken), steep, broken


@njit(cache=True, nogil=True)
def _mark(
    first: int,
    after: int,
    cells: Cells,
    steps: Steps,
    steep: NDArray[np.bool_],
    broken: NDArray[np.bool_],
) -> None:
    """Mark steps in the columns first...after of cells."""
    place, error = cells.place, cells.error
    rows = len(error)
    for i in range(rows):
        for c in range(first, after):
            chance = _SIGNIFICANT * np.sqrt(2.0) * steps.noise[_HALF] * error[i, c]
            steep[i, c] = cells.kink[i, c, 0] > steps.slope * cells.kink[i, c, 1] + chance
    for b in range(len(BASELINES)):
        k = BASELINES[b]
        factor = _SIGNIFICANT * np.sqrt(2.0) * steps.noise[b]
        for i in range(rows - k):
            for c in range(first, after):
                rise = abs(place[i, c, 0] - place[i + k, c, 0])
                # Also false where one of the two is not measured.
                if not rise > factor * max(error[i, c], error[i + k, c]):
                    continue
                if not _step(place, error, factor, steps, i, c, i + k, c, k <= _GAP):
                    continue
                broken[i, c] = True
                # Between the two, and as far as the measurement goes where it ends there.
                start, end = i + 1, i + k
                if k > 1 and (i == 0 or np.isnan(place[i - 1, c, 0])):
                    start = i
                if k > 1 and (i + k + 1 == rows or np.isnan(place[i + k + 1, c, 0])):
                    end = i + k + 1
                for m in range(start, end):
                    steep[m, c] = True
                    broken[m, c] = True


@njit(cache=True, nogil=True)
def _step(
    place: NDArray[np.float32],
    error: NDArray[np.float32],
    factor: float,
    steps: Steps,
    i: int,
    c: int,
    k: int,
    m: int,
    neighbours: bool,
) -> bool:
    """Whether cells (i, c) and (k, m) differ by more than the ground may; false if unknown.

    Cells of nine parameters: two places, which kernels do not take as one.
    """
    rise = abs(place[i, c, 0] - place[k, m, 0])
    x, y = place[i, c, 1] - place[k, m, 1], place[i, c, 2] - place[k, m, 2]
    way = np.sqrt(x * x + y * y)  # several times faster than hypot
    chance = factor * max(error[i, c], error[k, m])
    allowed = steps.slope * way + chance
    if neighbours:
        # A step down, or along the view, is fatal where it is taken for a ramp; one up only hides.
        farther = place[i, c, 1] ** 2 + place[i, c, 2] ** 2
        farther -= place[k, m, 1] ** 2 + place[k, m, 2] ** 2
        up = i != k and (place[i, c, 0] - place[k, m, 0]) * farther > 0
        allowed = min(allowed, max(steps.least if up else steps.beside, chance))
    return rise > allowed


@njit(cache=True, nogil=True)
def join_cells(
    cells: Cells, steps: Steps, steep: NDArray[np.bool_], broken: NDArray[np.bool_]
) -> tuple[NDArray[np.int32], int]:
    """Surfaces of the cells that are not steep, along links that are not broken; their number."""
    place, error = cells.place, cells.error
    rows, columns = error.shape
    factors = _SIGNIFICANT * np.sqrt(2.0) * steps.noise
    parent = np.arange(rows * columns, dtype=np.int32)
    for i in range(rows):
        for c in range(columns):
            if steep[i, c] or np.isnan(place[i, c, 0]):
                continue
            for k in range(1, _GAP + 1):  # the next measured cell below
                if broken[i, c] or i + k >= rows or steep[i + k, c]:
                    break
                if not np.isnan(place[i + k, c, 0]):
                    if not _step(place, error, factors[0], steps, i, c, i + k, c, True):
                        _join(parent, i * columns + c, (i + k) * columns + c)
                    break
            # The one to the right, where the next but one agrees on either side.
            if c + 1 < columns and not steep[i, c + 1] and not np.isnan(place[i, c + 1, 0]):
                apart = _step(place, error, factors[_NEXT], steps, i, c, i, c + 1, True)
                if c + 2 < columns:
                    apart |= _step(place, error, factors[_SECOND], steps, i, c, i, c + 2, True)
                if c > 0:
                    apart |= _step(place, error, factors[_SECOND], steps, i, c - 1, i, c + 1, True)
                if not apart:
                    _join(parent, i * columns + c, i * columns + c + 1)
    label = np.zeros((rows, columns), np.int32)
    count = 0
    for i in range(rows):
        for c in range(columns):
            if steep[i, c] or np.isnan(place[i, c, 0]):
                continue
            root = _find(parent, i * columns + c)
            a, b = root // columns, root % columns
            if label[a, b] == 0:
                count += 1
                label[a, b] = count
            label[i, c] = label[a, b]
    return label, count


@njit(cache=True, nogil=True)
def _find(parent: NDArray[np.int32], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def _join(parent: NDArray[np.int32], i: int, k: int) -> None:
    a, b = _find(parent, i), _find(parent, k)
    # The smaller root, so that the result does not depend on the order.
    parent[max(a, b)] = min(a, b)
