"""Sums over the cells of regions: all that planes, their errors and their bend need of the pixels.

Each region's bounding box is cut into at most `MAX_CELLS` square cells of whole blocks. What is
linear in the pixels, like a fit, adds up over cells; what couples pairs of pixels, like correlated
errors, couples pairs of cells by the mean and the variance of their pixels' positions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.moments import (
    CHI2,
    COUNT,
    NO_PIXEL,
    fit,
    plus_pixel,
    ray_of,
    squares_left,
)
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import OUTLIER

MAX_CELLS = 64
"""Cells of a region at most."""
RAY, INVERSE, WEIGHT, POINT, SCATTER, PLACE, RECORD = 11, 14, 15, 16, 19, 25, 29
"""Entries of a cell after its moment vector, which lacks the variance ratios: w r (3), w y, w,
p (3), p p^T (6), and v, u, v^2, u^2 (4) of the row v and the column u; their number."""


class Layout(NamedTuple):
    """Cells of regions 0...M; region 0 has none.

    Attributes
    ----------
    box : (M + 1, 4) int
        First row and column of each region, and the ones after its last; zeros without pixels.
    size, columns : (M + 1,) int
        Rows and columns of a cell, and cells side by side.
    start : (M + 2,) int
        Where each region's cells begin.
    """

    box: NDArray[np.intp]
    size: NDArray[np.intp]
    columns: NDArray[np.intp]
    start: NDArray[np.intp]


class RegionSums(NamedTuple):
    """Sums over regions 0...M, without outliers.

    Attributes
    ----------
    box : (M + 1, 4) int
        See `Layout`.
    start : (M + 2,) int
        Where each region's cells begin in `cells`.
    cells : (N, 29) float64
        See `RECORD`.
    pixels, outliers : (M + 1,) int
        Number of measured pixels, and of those beyond four standard deviations.
    """

    box: NDArray[np.intp]
    start: NDArray[np.intp]
    cells: NDArray[np.float64]
    pixels: NDArray[np.intp]
    outliers: NDArray[np.intp]

    def without(self, dropped: NDArray[np.bool_]) -> RegionSums:
        """Those of regions that are not `dropped` (M + 1,), numbered anew."""
        kept, length = ~dropped, np.diff(self.start)
        start = np.concatenate([[0], np.cumsum(length[kept])])
        cells = self.cells[np.repeat(kept, length)]
        return RegionSums(self.box[kept], start, cells, self.pixels[kept], self.outliers[kept])


def sum_regions(
    labels: NDArray[np.uint16], image: RangeImage, blocks: Blocks, sensor: SensorModel
) -> tuple[RegionSums, NDArray[np.float64]]:
    """Sum up the measured pixels of regions, but for outliers from their least-squares planes.

    Outliers are beyond four standard deviations of the sensor's errors from the plane of all
    pixels. A region keeps them where they are more than half of it: it is then the sensor model
    that does not fit, or no plane.

    Parameters
    ----------
    labels : (H, W) uint16
        0...M, 0 for no region.
    image : RangeImage
        (H, W).
    blocks : Blocks
        Of 4 x 4 pixels of the image. Where a region fills one, its moments stand for the pixels.
    sensor : SensorModel

    Returns
    -------
    RegionSums
    total : (M + 1, 29) float64
        Sums over the cells of each region.
    """
    count = int(labels.max(initial=0)) + 1
    layout = Layout(*_lay_out(*map_halves(_find_boxes, len(labels), labels, count)))
    axis = image.camera.axes[:, 2].copy() if image.camera is not None else np.zeros(3)
    pixels = image.inverse, image.rays, image.pinhole, image.camera is not None, axis
    rows = len(blocks.squared)

    def accumulate(theta: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        given = labels, *pixels, blocks, sensor, layout, theta
        (upper, out), (lower, also_out) = map_halves(_accumulate, rows, *given)
        return upper + lower, out + also_out

    cells, _ = accumulate(np.zeros((count, 3)))
    total = _totals(layout.start, cells)
    trimmed, outliers = accumulate(fit_sums(total))
    measured = total[:, COUNT].astype(np.intp)
    cells = _trim(layout.start, cells, trimmed, 2 * outliers <= measured)
    sums = RegionSums(layout.box, layout.start, cells, measured, outliers)
    return sums, _totals(layout.start, cells)


@njit(cache=True)
def fit_sums(total: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least-squares planes theta . ray = inverse range (M + 1, 3); zeros where there is none."""
    theta = np.zeros((len(total), 3))
    for k in range(1, len(total)):
        if total[k, COUNT] >= 3:
            fit(total[k], theta[k])
    return theta


@njit(cache=True, nogil=True)
def _find_boxes(
    first: int, after: int, labels: NDArray[np.uint16], count: int
) -> NDArray[np.intp]:
    """Bounding boxes (count, 4) of the regions in some rows; zeros without pixels."""
    width = labels.shape[1]
    box = np.zeros((count, 4), np.intp)
    for i in range(first, after):
        begin = 0
        for j in range(1, width + 1):
            if j < width and labels[i, j] == labels[i, begin]:
                continue
            label = labels[i, begin]
            if box[label, 2] == 0:
                box[label, 0], box[label, 1] = i, begin
            box[label, 1], box[label, 2] = min(box[label, 1], begin), i + 1
            box[label, 3] = max(box[label, 3], j)
            begin = j
    box[0] = 0
    return box


@njit(cache=True)
def _lay_out(box: NDArray[np.intp], lower: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """Fields of the `Layout`: cells for the boxes of regions in both halves of an image."""
    count = len(box)
    size, columns = np.full(count, BLOCK), np.zeros(count, np.intp)
    start = np.zeros(count + 1, np.intp)
    for k in range(count):
        if box[k, 2] == 0:
            box[k] = lower[k]
        elif lower[k, 2] > 0:
            box[k, 1] = min(box[k, 1], lower[k, 1])
            box[k, 2], box[k, 3] = lower[k, 2], max(box[k, 3], lower[k, 3])
        top, left = box[k, 0] // BLOCK, box[k, 1] // BLOCK
        rows, across = -(-box[k, 2] // BLOCK) - top, -(-box[k, 3] // BLOCK) - left
        side = max(int(np.sqrt(rows * across / MAX_CELLS)), 1)
        while -(-rows // side) * -(-across // side) > MAX_CELLS:
            side += 1
        size[k], columns[k] = side * BLOCK, -(-across // side)
        start[k + 1] = start[k] + (-(-rows // side)) * columns[k]
    return box, size, columns, start


@njit(cache=True, inline='always')
def _cell_of(layout: Layout, label: int, bi: int, bj: int) -> int:
    """Cell of a region's pixels in a block: cells consist of whole blocks."""
    side = layout.size[label] // BLOCK
    row = (bi - layout.box[label, 0] // BLOCK) // side
    column = (bj - layout.box[label, 1] // BLOCK) // side
    return layout.start[label] + row * layout.columns[label] + column


@njit(cache=True, nogil=True)
def _accumulate(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    central: bool,
    axis: NDArray[np.float64],
    blocks: Blocks,
    sensor: SensorModel,
    layout: Layout,
    theta: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Sums (N, 29) over the pixels in some rows of blocks, and numbers (M + 1,) of outliers.

    Without outliers of `theta` (M + 1, 3); of regions whose plane is zero all pixels count.
    """
    height, width = labels.shape
    cells = np.zeros((layout.start[-1], RECORD))
    outliers = np.zeros(len(theta), np.intp)
    for bi in range(first, after):
        bottom = min((bi + 1) * BLOCK, height)
        for bj in range(blocks.squared.shape[1]):
            right = min((bj + 1) * BLOCK, width)
            label, squared = labels[bi * BLOCK, bj * BLOCK], blocks.squared[bi, bj]
            if squared == 0:
                continue
            unlike = label ^ label
            for i in range(bi * BLOCK, bottom):
                for j in range(bj * BLOCK, right):
                    unlike |= labels[i, j] ^ label
            if unlike == 0:
                if label == 0:
                    continue
                variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
                plane, moments = theta[label], blocks.moments[bi, bj]
                limit = OUTLIER**2 * variance
                # No pixel is farther off than all together.
                explained = not plane.any() or squares_left(moments, plane) <= limit
                if central and not explained:
                    explained = True
                    for i in range(bi * BLOCK, bottom):
                        for j in range(bj * BLOCK, right):
                            ray, y = ray_of(rays, pinhole, i, j), float(inverse[i, j])
                            left = y - plane[0] * ray[0] - plane[1] * ray[1] - plane[2] * ray[2]
                            explained &= (left * left <= limit) | (y == 0)
                # Rays of a cloud are not of one length along any axis: their sums are not known.
                if central and explained:
                    record = cells[_cell_of(layout, label, bi, bj)]
                    middle = (bi * BLOCK + bottom - 1) / 2, (bj * BLOCK + right - 1) / 2
                    _add_block(record, moments, squared, sensor, axis, middle)
                    continue
            for i in range(bi * BLOCK, bottom):
                for j in range(bj * BLOCK, right):
                    label, y = labels[i, j], float(inverse[i, j])
                    if label == 0 or y == 0:
                        continue
                    ray = ray_of(rays, pinhole, i, j)
                    a, b, c = theta[label, 0], theta[label, 1], theta[label, 2]
                    squared = y * y
                    variance = random_variance(sensor, squared)
                    left = y - a * ray[0] - b * ray[1] - c * ray[2]
                    limit = OUTLIER**2 * (variance + systematic_variance(sensor, squared))
                    if (a != 0 or b != 0 or c != 0) and left * left > limit:
                        outliers[label] += 1
                        continue
                    # Seen from one centre, the error is in the inverse range. Otherwise its
                    # direction is unknown, and weights are those of distances from the plane.
                    weight = 1 / (variance if central else squared)
                    record = cells[_cell_of(layout, label, bi, bj)]
                    _add_pixel(record, float(i), float(j), ray, y, weight)
    return cells, outliers


@njit(cache=True, inline='always')
def _add_pixel(
    record: NDArray[np.float64],
    i: float,
    j: float,
    ray: tuple[float, float, float],
    y: float,
    weight: float,
) -> None:
    """Add a pixel to a cell."""
    x0, x1, x2 = float(ray[0]), float(ray[1]), float(ray[2])
    for entry, value in enumerate(plus_pixel(NO_PIXEL, x0, x1, x2, y, weight)):
        record[entry] += value
    ones = 1.0, weight * x0, weight * x1, weight * x2, weight * y, weight
    for entry, value in enumerate(ones):
        record[COUNT + entry] += value
    points = plus_pixel(NO_PIXEL, x0 / y, x1 / y, x2 / y, 1.0, 1.0)
    for entry in range(6):
        record[SCATTER + entry] += points[entry]
    for entry in range(3):
        record[POINT + entry] += points[6 + entry]
    for entry, value in enumerate((i, j, i * i, j * j)):
        record[PLACE + entry] += value


@njit(cache=True, inline='always')
def _add_block(
    record: NDArray[np.float64],
    moments: NDArray[np.float64],
    squared: float,
    sensor: SensorModel,
    axis: NDArray[np.float64],
    middle: tuple[float, float],
) -> None:
    """Add a block, of moments with unit weights, to a cell: rays are 1 long along `axis`."""
    weight, count = 1 / random_variance(sensor, squared), moments[COUNT]
    for entry in range(CHI2 + 1):
        record[entry] += weight * moments[entry]
    record[COUNT] += count
    # The sum of r r^T f is that of r where r^T f is 1.
    for entry, (a, b, c) in enumerate(((0, 1, 2), (1, 3, 4), (2, 4, 5), (6, 7, 8))):
        along = axis[0] * moments[a] + axis[1] * moments[b] + axis[2] * moments[c]
        record[RAY + entry] += weight * along
    record[WEIGHT] += weight * count
    # With 1 / y^2 for weights, sums of r y and r r^T are those of points and of their squares.
    for entry in range(3):
        record[POINT + entry] += moments[6 + entry] / squared
    for entry in range(6):
        record[SCATTER + entry] += moments[entry] / squared
    spread = (BLOCK**2 - 1) / 12
    for entry in range(2):
        record[PLACE + entry] += count * middle[entry]
        record[PLACE + 2 + entry] += count * (middle[entry] ** 2 + spread)


@njit(cache=True)
def _trim(
    start: NDArray[np.intp],
    cells: NDArray[np.float64],
    trimmed: NDArray[np.float64],
    few: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Cells `trimmed` of the regions that have `few` outliers, and all pixels of the others."""
    for k in range(len(few)):
        if few[k]:
            cells[start[k] : start[k + 1]] = trimmed[start[k] : start[k + 1]]
    return cells


@njit(cache=True)
def _totals(start: NDArray[np.intp], cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over the cells of each region, (M + 1, 29)."""
    total = np.zeros((len(start) - 1, RECORD))
    for k in range(len(total)):
        for c in range(start[k], start[k + 1]):
            total[k] += cells[c]
    return total
