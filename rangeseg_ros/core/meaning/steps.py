"""What a step is between two cells: more than the ground rises, and than noise explains."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import Cells
from rangeseg_ros.core.sensing.bridges import SPAN
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.significance import OUTLIER

BASELINES = (1, 2, 4, 8, 16)
"""Rows between cells that are compared; neighbours are as far apart as four rows or more."""
BROAD = 3
"""Baseline of the noise that cells of a patch share."""
DIFFERENCE = OUTLIER * math.sqrt(2.0)
"""What a step between two cells must exceed, in standard deviations of the noise of one."""
GAP = SPAN // 2
"""Cells without a measurement that a surface may reach across: the holes that are bridged, as a
cell has two rows of an image of VGA."""


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
        shown = math.erf(GAP / (2 * math.sqrt(2) * blur)) if blur > 0 else 1.0
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
    found = np.ones(len(BASELINES))
    for b, spread in enumerate(_spreads(cells.inverse, sensor)):
        if spread >= 0:
            found[b] = spread
        elif b:
            found[b] = found[b - 1]
        # Never less than at shorter ones, nor than rounding makes.
        found[b] = max(found[b], found[b - 1] if b else 0.05)
    return found


@njit(cache=True, nogil=True)
def _spreads(inverse: NDArray[np.float32], sensor: SensorModel) -> NDArray[np.float64]:
    """Standard deviations of second differences, relative to the sensor model; -1 where none is.

    (B,), one for each of `BASELINES`.
    """
    rows, columns = inverse.shape
    found = np.full(len(BASELINES), -1.0)
    # Squares of second differences over their variance.
    bends = np.empty(-(-rows // 2) * -(-columns // 4))
    for b in range(len(BASELINES)):
        k, count = BASELINES[b], 0
        for i in range(k, rows - k, 2):
            for c in range(0, columns, 4):
                above, middle, below = inverse[i - k, c], inverse[i, c], inverse[i + k, c]
                if above > 0 and middle > 0 and below > 0:
                    bend = above - 2 * middle + below
                    bends[count] = bend * bend / random_variance(sensor, middle * middle)
                    count += 1
        if count:
            # Of a normal distribution, 40 % lie within 0.524 standard deviations.
            found[b] = np.sqrt(_ranked(bends[:count], int(0.4 * count)) / 6) / 0.524
    return found


@njit(cache=True, nogil=True)
def _ranked(values: NDArray[np.float64], rank: int) -> float:
    """The value that so many are smaller than, of numbers that are not negative.

    Told only among those of its power of two, as their bits are in the order of the numbers:
    several times faster than a partition of all.
    """
    power = (values.view(np.int64) >> 52).astype(np.int32)
    number = np.zeros(1 << 11, np.int64)
    for k in range(len(power)):
        number[power[k]] += 1
    own = 0
    while rank >= number[own]:
        rank -= number[own]
        own += 1
    alike = np.empty(number[own])
    count = 0
    for k in range(len(values)):
        if power[k] == own:
            alike[count] = values[k]
            count += 1
    return float(np.partition(alike, rank)[rank])


@njit(cache=True, inline='always')
def is_step(
    place: NDArray[np.float32],
    error: NDArray[np.float32],
    factor: np.float32,
    slope: np.float32,
    up: np.float32,
    down: np.float32,
    i: int,
    c: int,
    k: int,
    m: int,
) -> bool:
    """Whether cells (i, c) and (k, m) differ by more than the ground may; false if unknown.

    Ten parameters: two places, which kernels do not take as one, and the four numbers that tell
    a step: standard deviations of the noise, the steepest ground, and what it may rise or fall by
    beyond the noise.
    """
    x, y = place[1, i, c], place[2, i, c]
    p, q = place[1, k, m], place[2, k, m]
    rise = place[0, i, c] - place[0, k, m]
    way = np.sqrt((x - p) * (x - p) + (y - q) * (y - q))  # several times faster than hypot
    chance = factor * max(error[i, c], error[k, m])
    # Neighbours in a row are along the view.
    farther = x * x + y * y - p * p - q * q
    least = up if (i != k) & (rise * farther > 0) else down
    return abs(rise) > min(slope * way + chance, max(least, chance))
