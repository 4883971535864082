"""Sums over the cells of regions: all that planes and their uncertainty need of the pixels.

Each region's bounding box is cut into at most `MAX_CELLS` square cells, of whole blocks unless it
is small. What is linear in the pixels, like a fit, adds up over cells; what couples pairs of
pixels, like correlated noise, couples pairs of cells instead.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.moments import CHI2, COUNT, NO_PIXEL, plus_pixel
from rangeseg_ros.core.sensing.ray_rows import ray_of
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance

MAX_CELLS = 100
"""Cells of a region at most."""
WEIGHTED_RAY, WEIGHT, POINT, SCATTER, RECORD = 12, 15, 16, 19, 25
"""Entries of a cell after its moment vector, which lacks w y^2 and the variance ratio: w r (3), w,
p (3), p p^T (6); their number."""


class Cells(NamedTuple):
    """Regions 0...M cut into cells; region 0 has none.

    Attributes
    ----------
    box : (M + 1, 4) int
        First row and column of each region, and the ones after its last; zeros without pixels.
    border : (M + 1,) int
        Sides of pixels where a region ends.
    origin : (M + 1, 2) int
        First row and column of each region's first cell.
    size : (M + 1,) int
        Rows and columns of a region's cells: fewer than those of a block, or those of some.
    columns : (M + 1,) int
        Cells side by side.
    start : (M + 2,) int
        Where each region's cells begin in `sums`.
    sums : (N, 25) float64
        A moment vector and the entries after it, for each cell.
    """

    box: NDArray[np.intp]
    border: NDArray[np.intp]
    origin: NDArray[np.intp]
    size: NDArray[np.intp]
    columns: NDArray[np.intp]
    start: NDArray[np.intp]
    sums: NDArray[np.float64]

    @classmethod
    def empty(cls, box: NDArray[np.intp], border: NDArray[np.intp]) -> Cells:
        """Cells of regions with these boxes and borders, and nothing in them."""
        origin, size, columns, start = _cut(box)
        return cls(box, border, origin, size, columns, start, np.zeros((start[-1], RECORD)))

    def regions(self) -> NDArray[np.float64]:
        """Sums over whole regions, (M + 1, 25)."""
        return _regions(self.start, self.sums)


@njit(cache=True)
def _cut(
    box: NDArray[np.intp],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Origin, size, columns and start of the cells of regions with these boxes, see `Cells`."""
    count = len(box)
    origin, start = np.empty((count, 2), np.intp), np.zeros(count + 1, np.intp)
    size, columns = np.empty(count, np.intp), np.empty(count, np.intp)
    for k in range(count):
        top, left, bottom, right = box[k]
        side = max(int(np.ceil(np.sqrt((bottom - top) * (right - left) / MAX_CELLS))), 1)
        step = 1
        if side >= BLOCK:
            # From the size of a block on, cells begin and end where blocks do.
            step = BLOCK
            side = -(-side // BLOCK) * BLOCK
            top, left = top // BLOCK * BLOCK, left // BLOCK * BLOCK
        # What is begun counts: the negative quotients are rounded down.
        while -((top - bottom) // side) * -((left - right) // side) > MAX_CELLS:
            side += step
        origin[k, 0], origin[k, 1] = top, left
        size[k], columns[k] = side, -((left - right) // side)
        start[k + 1] = start[k] - (top - bottom) // side * columns[k]
    return origin, size, columns, start


@njit(cache=True)
def _regions(start: NDArray[np.intp], sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over the cells of each region."""
    total = np.zeros((len(start) - 1, RECORD))
    for k in range(len(total)):
        for c in range(start[k], start[k + 1]):
            for entry in range(RECORD):
                total[k, entry] += sums[c, entry]
    return total


@njit(cache=True)
def cell_of(cells: Cells, label: int, i: int, j: int) -> int:
    """Cell of a pixel of a region."""
    size = cells.size[label]
    row, column = (i - cells.origin[label, 0]) // size, (j - cells.origin[label, 1]) // size
    return int(cells.start[label] + row * cells.columns[label] + column)


@njit(cache=True)
def is_empty(cell: NDArray[np.float64]) -> bool:
    """Whether no pixel is in a cell, or rounding has left nothing of what weighs next to nothing.

    Of pixels whose weights differ by 1e16, where others were taken off again.
    """
    return cell[COUNT] == 0 or cell[WEIGHT] <= 0


@njit(cache=True)
def level_of(cell: NDArray[np.float64], theta: NDArray[np.float64]) -> float:
    """Inverse range of a plane at the middle of a cell."""
    total = 0.0
    for a in range(3):
        total += theta[a] * cell[WEIGHTED_RAY + a]
    return total / cell[WEIGHT]


@njit(cache=True, inline='always')
def add_pixels(
    record: NDArray[np.float64],
    i: int,
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    sensor: SensorModel,
    central: bool,
) -> None:
    """Add pixels `first` to before `after` of row `i` to a cell."""
    moments, points = NO_PIXEL, NO_PIXEL
    count = w0 = w1 = w2 = weight = 0.0
    for j in range(first, after):
        y = float(inverse[i, j])
        if y == 0:
            continue
        # Seen from one centre, the error is in the inverse range; otherwise its direction is
        # unknown, and the weights are those of plain distances from the plane (up to a constant).
        squared = y * y
        w = 1 / random_variance(sensor, squared) if central else 1 / squared
        count += 1
        weight += w
        ray = ray_of(rays, pinhole, i, j)
        x0, x1, x2 = float(ray[0]), float(ray[1]), float(ray[2])
        w0, w1, w2 = w0 + w * x0, w1 + w * x1, w2 + w * x2
        moments = plus_pixel(moments, x0, x1, x2, y, w)
        # Sums of the points and of their squares.
        z = 1 / y
        points = plus_pixel(points, z * x0, z * x1, z * x2, 1.0, 1.0)
    for entry in range(CHI2):
        record[entry] += moments[entry]
    for entry in range(6):
        record[SCATTER + entry] += points[entry]
    for entry in range(3):
        record[POINT + entry] += points[6 + entry]
    record[COUNT] += count
    for entry, value in enumerate((w0, w1, w2, weight)):
        record[WEIGHTED_RAY + entry] += value


@njit(cache=True, inline='always')
def add_block(
    record: NDArray[np.float64],
    moments: NDArray[np.float64],
    squared: float,
    sensor: SensorModel,
    forward: NDArray[np.float64],
) -> None:
    """Add a block, of moments with unit weights, to a cell: rays are 1 long along `forward`."""
    w = 1 / random_variance(sensor, squared)
    for entry in range(CHI2):
        record[entry] += w * moments[entry]
    record[COUNT] += moments[COUNT]
    # The sum of r r^T f is that of r where r^T f is 1.
    for entry, (a, b, c) in enumerate(((0, 1, 2), (1, 3, 4), (2, 4, 5))):
        along = forward[0] * moments[a] + forward[1] * moments[b] + forward[2] * moments[c]
        record[WEIGHTED_RAY + entry] += w * along
    record[WEIGHT] += w * moments[COUNT]
    # With 1 / y^2 for weights, sums of r y and r r^T are those of points and of their squares.
    w = 1 / squared
    for entry in range(3):
        record[POINT + entry] += w * moments[6 + entry]
    for entry in range(6):
        record[SCATTER + entry] += w * moments[entry]
