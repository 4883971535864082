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

from rangeseg_ros.core.arrays import Floats, Indices, Ints, Labels, Mask, Singles
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.moments import (
    CHI2,
    COUNT,
    NO_PIXEL,
    fit_all,
    plus_pixel,
    ray_of,
    squares_left,
    sum_by_label,
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
    """Cells of regions 0...M; region 0 has none."""

    box: Indices  # (M + 1, 4), first row and column, those after the last; or zeros
    side: Indices  # (M + 1,), blocks along the side of a cell
    columns: Indices  # (M + 1,), cells side by side
    start: Indices  # (M + 2,), where each region's cells begin

    @classmethod
    def of(cls, labels: Labels) -> Layout:
        """Cells of whole blocks for the regions of labels (H, W), as small as may be."""
        box = find_boxes(labels, int(labels.max(initial=0)) + 1)
        first, after = box[:, :2], box[:, 2:]
        rows, across = (-(-after // BLOCK) - first // BLOCK).T
        side = np.maximum(np.sqrt(rows * across / MAX_CELLS).astype(np.intp), 1)
        while (many := -(-rows // side) * -(-across // side) > MAX_CELLS).any():
            side += many
        columns = -(-across // side)
        start = np.concatenate([[0], np.cumsum(-(-rows // side) * columns)])
        return cls(box, side, columns, start)


class RegionSums(NamedTuple):
    """Sums over regions 0...M, without outliers unless these are the majority."""

    box: Indices  # (M + 1, 4), see `Layout`
    start: Indices  # (M + 2,), where each region's cells begin in `cells`
    cells: Floats  # (N, 29), those with pixels, see `RECORD`
    pixels: Indices  # (M + 1,), number of measured pixels
    outliers: Indices  # (M + 1,), of these far from the plane; left out unless they are most

    @property
    def owners(self) -> Indices:
        """Region (N,) of each cell."""
        return regions_of(self.start)

    def without(self, dropped: Mask) -> RegionSums:
        """Those of regions that are not `dropped` (M + 1,), numbered anew."""
        kept, length = ~dropped, np.diff(self.start)
        start = np.concatenate([[0], np.cumsum(length[kept])])
        cells = self.cells[np.repeat(kept, length)]
        return RegionSums(self.box[kept], start, cells, self.pixels[kept], self.outliers[kept])


def sum_regions(
    labels: Labels, image: RangeImage, blocks: Blocks, sensor: SensorModel
) -> tuple[RegionSums, Floats]:
    """Sums over the pixels of regions (H, W), but for outliers from their least-squares planes.

    Outliers are beyond four standard deviations of the sensor's errors from the plane of the
    blocks (of 4 x 4 pixels) that the region fills. It keeps them where they are more than half of
    it: then the sensor model does not fit, or there is no plane. Also returns the sums (M + 1, 29)
    over the cells of each region.
    """
    layout = Layout.of(labels)
    inside = _labels_of_blocks(labels)
    axis = image.camera.axes[:, 2].copy() if image.camera is not None else np.zeros(3)
    pixels = labels, inside, image.inverse, image.rays, image.pinhole, image.camera is not None
    moments = blocks.moments.reshape(inside.size, -1)
    planes = fit_sums(sum_by_label(inside.ravel(), moments, len(layout.box)))
    halves = map_halves(_accumulate, len(inside), *pixels, axis, blocks, sensor, layout, planes)
    cells, outside = np.add(*halves)
    owners, count = regions_of(layout.start), len(layout.box)
    total, left_out = (sum_by_label(owners, part, count) for part in (cells, outside))
    outliers = left_out[:, COUNT].astype(np.intp)
    measured = total[:, COUNT].astype(np.intp) + outliers
    many = 2 * outliers > measured
    if many.any():
        cells += outside * many[owners, None]
        total += left_out * many[:, None]
    kept = cells[:, COUNT] > 0
    start = np.searchsorted(np.flatnonzero(kept), layout.start)
    return RegionSums(layout.box, start, cells[kept], measured, outliers), total


def fit_sums(total: Floats) -> Floats:
    """Least-squares planes theta . ray = inverse range (M + 1, 3); zeros where there is none."""
    return np.where(total[:, COUNT, None] >= 3, fit_all(total)[0], 0)


def regions_of(start: Indices) -> Indices:
    """Region (N,) of each cell, where those of regions 0...M begin at `start` (M + 2,)."""
    return np.repeat(np.arange(len(start) - 1), np.diff(start))


@njit(cache=True, nogil=True)
def find_boxes(labels: NDArray[np.integer], count: int) -> Indices:
    """Bounding boxes (count, 4) of regions 1...count - 1, see `Layout`."""
    height, width = labels.shape
    box = np.zeros((count, 4), np.intp)
    box[:, 0], box[:, 1] = height, width
    for i in range(height):
        begin = 0
        for j in range(1, width + 1):
            if j < width and labels[i, j] == labels[i, begin]:
                continue
            label = labels[i, begin]
            box[label, 0], box[label, 1] = min(box[label, 0], i), min(box[label, 1], begin)
            box[label, 2], box[label, 3] = i + 1, max(box[label, 3], j)
            begin = j
    for k in range(count):
        if k == 0 or box[k, 2] == 0:
            box[k] = 0
    return box


@njit(cache=True, nogil=True)
def _labels_of_blocks(labels: Labels) -> Ints:
    """Labels (rows, columns) of all pixels of each block; -1 where they have several."""
    height, width = labels.shape
    result = np.empty((-(-height // BLOCK), -(-width // BLOCK)), np.int32)
    for bi in range(result.shape[0]):
        for bj in range(result.shape[1]):
            label = labels[bi * BLOCK, bj * BLOCK]
            unlike = label ^ label
            for i in range(bi * BLOCK, min((bi + 1) * BLOCK, height)):
                for j in range(bj * BLOCK, min((bj + 1) * BLOCK, width)):
                    unlike |= labels[i, j] ^ label
            result[bi, bj] = label if unlike == 0 else -1
    return result


@njit(cache=True, inline='always')
def _cell_of(layout: Layout, label: int, bi: int, bj: int) -> int:
    """Cell of a region's pixels in a block: cells consist of whole blocks."""
    row = (bi - layout.box[label, 0] // BLOCK) // layout.side[label]
    column = (bj - layout.box[label, 1] // BLOCK) // layout.side[label]
    return layout.start[label] + row * layout.columns[label] + column


@njit(cache=True, nogil=True)
def _accumulate(
    first: int,
    after: int,
    labels: Labels,
    inside: Ints,
    inverse: Singles,
    rays: Singles,
    pinhole: bool,
    central: bool,
    axis: Floats,
    blocks: Blocks,
    sensor: SensorModel,
    layout: Layout,
    theta: Floats,
) -> Floats:
    """Sums (2, N, 29) over rows first...after of blocks: of inliers of `theta`, of outliers.

    Of regions whose plane (M + 1, 3) is zero there are no outliers.
    """
    height, width = labels.shape
    cells = np.zeros((2, layout.start[-1], RECORD))
    for bi in range(first, after):
        bottom = min((bi + 1) * BLOCK, height)
        for bj in range(inside.shape[1]):
            right, squared = min((bj + 1) * BLOCK, width), blocks.squared[bi, bj]
            label = int(inside[bi, bj])
            if squared == 0 or label == 0:
                continue
            # Rays of a cloud are not of one length along any axis: their sums are not known.
            if central and label > 0:
                plane, moments = theta[label], blocks.moments[bi, bj]
                limit = random_variance(sensor, squared) + systematic_variance(sensor, squared)
                limit *= OUTLIER**2 * moments[COUNT]
                if not plane.any() or squares_left(moments, plane) <= limit:
                    record = cells[0, _cell_of(layout, label, bi, bj)]
                    middle = (bi * BLOCK + bottom - 1) / 2, (bj * BLOCK + right - 1) / 2
                    _add_block(record, moments, squared, sensor, axis, middle)
                    continue
            for i in range(bi * BLOCK, bottom):
                for j in range(bj * BLOCK, right):
                    label, y = int(labels[i, j]), float(inverse[i, j])
                    if label == 0 or y == 0:
                        continue
                    ray = ray_of(rays, pinhole, i, j)
                    a, b, c = theta[label, 0], theta[label, 1], theta[label, 2]
                    squared = y * y
                    variance = random_variance(sensor, squared)
                    left = y - a * ray[0] - b * ray[1] - c * ray[2]
                    limit = OUTLIER**2 * (variance + systematic_variance(sensor, squared))
                    far = (a != 0 or b != 0 or c != 0) and left * left > limit
                    # Seen from one centre, the error is in the inverse range. Otherwise its
                    # direction is unknown, and weights are those of distances from the plane.
                    weight = 1 / (variance if central else squared)
                    record = cells[1 if far else 0, _cell_of(layout, label, bi, bj)]
                    _add_pixel(record, float(i), float(j), ray, y, weight)
    return cells


@njit(cache=True, inline='always')
def _add_pixel(
    record: Floats, i: float, j: float, ray: tuple[float, float, float], y: float, weight: float
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
    record: Floats,
    moments: Floats,
    squared: float,
    sensor: SensorModel,
    axis: Floats,
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
