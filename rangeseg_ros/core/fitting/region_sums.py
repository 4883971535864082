"""Sums over the cells of regions: all that planes, their errors and their bend need of the pixels.

Each region's bounding box is cut into at most `MAX_CELLS` square cells of whole blocks. What is
linear in the pixels, like a fit, adds up over cells; what couples pairs of pixels, like correlated
errors, couples pairs of cells by the mean and the variance of their pixels' positions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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
    RATIO,
    SIZE,
    fit_all,
    plus_pixel,
    ray_of,
    squares_left,
    sum_by_label,
    sums_of,
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
    scale: Floats  # (M + 1,), cells per block along their side
    columns: Indices  # (M + 1,), cells side by side
    start: Indices  # (M + 2,), where each region's cells begin


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

    def united(self, number: Labels) -> RegionSums:
        """Those of unions of regions that get the same new `number` (M + 1,), 0 for none."""
        counts = (np.bincount(number, n).astype(np.intp) for n in (self.pixels, self.outliers))
        return RegionSums._of_cells(*_united(number, self), *counts)

    @classmethod
    def _of_cells(
        cls, box: Indices, start: Indices, cells: Floats, pixels: Indices, outliers: Indices
    ) -> RegionSums:
        """Those of all cells of a layout, of which those with pixels are kept."""
        kept = cells[:, COUNT] > 0
        start = np.searchsorted(np.flatnonzero(kept), start)
        return cls(box, start, cells[kept], pixels, outliers)

    def total(self) -> Floats:
        """Sums (M + 1, 29) over the cells of each region."""
        return sum_by_label(self.owners, self.cells, len(self.box))

    def moments(self, sensor: SensorModel) -> Floats:
        """Moment vectors (M + 1, 13) of regions, with weights of a sensor."""
        cells = self.cells
        squared = (cells[:, INVERSE] / cells[:, WEIGHT]) ** 2
        variance = random_variance(sensor, squared)
        moments = np.zeros((len(cells), SIZE))
        # Weights of a cloud are not those of its errors.
        unit = cells[:, COUNT] / (variance * cells[:, WEIGHT])
        moments[:, : CHI2 + 1] = cells[:, : CHI2 + 1] * unit[:, None]
        moments[:, COUNT] = cells[:, COUNT]
        moments[:, RATIO] = cells[:, COUNT] * systematic_variance(sensor, squared) / variance
        total = sum_by_label(self.owners, moments, len(self.box))
        # In a region of bridged pixels alone, nothing was measured.
        total[1:, COUNT] = np.maximum(total[1:, COUNT], 1)
        return total


def sum_regions(
    labels: Labels, image: RangeImage, blocks: Blocks, sensor: SensorModel
) -> RegionSums:
    """Sums over the pixels of regions (H, W), but for outliers from their least-squares planes.

    Outliers are beyond four standard deviations of the sensor's errors from the plane of the
    blocks (of 4 x 4 pixels) that the region fills. It keeps them where they are more than half of
    it: then the sensor model does not fit, or there is no plane.
    """
    layout = Layout(*_layout(find_boxes(labels, int(labels.max(initial=0)) + 1)))
    inside = _labels_of_blocks(labels)
    axis = image.camera.axes[:, 2].copy() if image.camera is not None else np.zeros(3)
    pixels = labels, inside, image.inverse, image.rays, image.pinhole, image.camera is not None
    moments = blocks.moments.reshape(inside.size, -1)
    planes = fit_sums(sum_by_label(inside.ravel(), moments, len(layout.box)))
    halves = map_halves(_accumulate, len(inside), *pixels, axis, blocks, sensor, layout, planes)
    cells, outside = np.add(*halves).reshape(2, -1, RECORD)
    owners, count = regions_of(layout.start), len(layout.box)
    inliers, outliers = (
        np.bincount(owners, part[:, COUNT], count).astype(np.intp) for part in (cells, outside)
    )
    many = outliers > inliers
    if many.any():
        cells += outside * many[owners, None]
    return RegionSums._of_cells(layout.box, layout.start, cells, inliers + outliers, outliers)


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
def _layout(box: Indices) -> tuple[Indices, Floats, Indices, Indices]:
    """`Layout` of whole blocks in bounding boxes (M + 1, 4), with cells as small as may be."""
    start = np.zeros(len(box) + 1, np.intp)
    scale, columns = np.empty(len(box)), np.empty(len(box), np.intp)
    for k in range(len(box)):
        rows = -(-box[k, 2] // BLOCK) - box[k, 0] // BLOCK
        across = -(-box[k, 3] // BLOCK) - box[k, 1] // BLOCK
        side = 1
        while -(-rows // side) * -(-across // side) > MAX_CELLS:
            side += 1
        scale[k], columns[k] = 1 / side, -(-across // side)
        start[k + 1] = start[k] - (-rows // side) * columns[k]
    return box, scale, columns, start


@njit(cache=True, nogil=True)
def _united(number: Labels, sums: RegionSums) -> tuple[Indices, Indices, Floats]:
    """Boxes and cells of regions by another number, 0 for none; sums (N, 29) over the cells."""
    box = np.zeros((int(number.max()) + 1, 4), np.intp)
    known = np.flatnonzero(number)
    for k in known:
        own, whole = sums.box[k], box[number[k]]
        first = whole[2] == 0
        for side in range(2):
            whole[side] = own[side] if first else min(whole[side], own[side])
            whole[2 + side] = max(whole[2 + side], own[2 + side])
    layout = Layout(*_layout(box))
    cells = np.zeros((layout.start[-1], RECORD))
    for k in known:
        for i in range(sums.start[k], sums.start[k + 1]):
            cell = sums.cells[i]
            row, column = cell[PLACE] / cell[COUNT], cell[PLACE + 1] / cell[COUNT]
            c = _cell_of(layout, number[k], int(row) // BLOCK, int(column) // BLOCK)
            for entry in range(RECORD):
                cells[c, entry] += cell[entry]
    return layout.box, layout.start, cells


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
    # By the middle of the block, which no rounding takes to the next cell. Not divided by the
    # side: of integers that takes most of the time of a block.
    row = int((bi + 0.5 - layout.box[label, 0] // BLOCK) * layout.scale[label])
    column = int((bj + 0.5 - layout.box[label, 1] // BLOCK) * layout.scale[label])
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
    """Sums (2 N, 29) over rows first...after of blocks: of inliers of `theta`, then of outliers.

    Of regions whose plane (M + 1, 3) is zero there are no outliers.
    """
    (height, width), columns, count = labels.shape, inside.shape[1], layout.start[-1]
    cells, moments = np.zeros((2 * count, RECORD)), blocks.moments.reshape(-1, SIZE)
    # By index: views of arrays would count references, those of the same arrays in both halves.
    for bi in range(first, after):
        bottom = min((bi + 1) * BLOCK, height)
        for bj in range(columns):
            right, squared = min((bj + 1) * BLOCK, width), blocks.squared[bi, bj]
            label, k = int(inside[bi, bj]), bi * columns + bj
            if squared == 0 or label == 0:
                continue
            # Rays of a cloud are not of one length along any axis: their sums are not known.
            if central and label > 0:
                a, b, c = theta[label, 0], theta[label, 1], theta[label, 2]
                limit = random_variance(sensor, squared) + systematic_variance(sensor, squared)
                limit *= OUTLIER**2 * moments[k, COUNT]
                fitted = a != 0 or b != 0 or c != 0
                if not fitted or squares_left(sums_of(moments, k), (a, b, c)) <= limit:
                    cell = _cell_of(layout, label, bi, bj)
                    middle = (bi * BLOCK + bottom - 1) / 2, (bj * BLOCK + right - 1) / 2
                    _add_block(cells, cell, moments, k, squared, sensor, axis, middle)
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
                    cell = _cell_of(layout, label, bi, bj) + count * far
                    _add_pixel(cells, cell, float(i), float(j), ray, y, weight)
    return cells


@njit(cache=True, inline='always')
def _add_pixel(
    cells: Floats, k: int, i: float, j: float, ray: tuple[Any, ...], y: float, weight: float
) -> None:
    """Add a pixel to one of the cells (N, 29)."""
    x0, x1, x2, far = float(ray[0]), float(ray[1]), float(ray[2]), 1 / y
    for entry, value in enumerate(plus_pixel(NO_PIXEL, x0, x1, x2, y, weight)):
        cells[k, entry] += value
    ones = 1.0, weight * x0, weight * x1, weight * x2, weight * y, weight
    for entry, value in enumerate(ones):
        cells[k, COUNT + entry] += value
    points = plus_pixel(NO_PIXEL, x0 * far, x1 * far, x2 * far, 1.0, 1.0)
    for entry in range(6):
        cells[k, SCATTER + entry] += points[entry]
    for entry in range(3):
        cells[k, POINT + entry] += points[6 + entry]
    for entry, value in enumerate((i, j, i * i, j * j)):
        cells[k, PLACE + entry] += value


@njit(cache=True, inline='always')
def _add_block(
    cells: Floats,
    k: int,
    moments: Floats,
    m: int,
    squared: float,
    sensor: SensorModel,
    axis: Floats,
    middle: tuple[float, float],
) -> None:
    """Add one of the blocks, of moments (B, 13) with unit weights, to one of the cells (N, 29).

    Rays are 1 long along `axis`.
    """
    weight, count, far = 1 / random_variance(sensor, squared), moments[m, COUNT], 1 / squared
    for entry in range(CHI2 + 1):
        cells[k, entry] += weight * moments[m, entry]
    cells[k, COUNT] += count
    # The sum of r r^T f is that of r where r^T f is 1.
    for entry, (a, b, c) in enumerate(((0, 1, 2), (1, 3, 4), (2, 4, 5), (6, 7, 8))):
        along = axis[0] * moments[m, a] + axis[1] * moments[m, b] + axis[2] * moments[m, c]
        cells[k, RAY + entry] += weight * along
    cells[k, WEIGHT] += weight * count
    # With 1 / y^2 for weights, sums of r y and r r^T are those of points and of their squares.
    for entry in range(3):
        cells[k, POINT + entry] += far * moments[m, 6 + entry]
    for entry in range(6):
        cells[k, SCATTER + entry] += far * moments[m, entry]
    spread = (BLOCK**2 - 1) / 12
    for entry in range(2):
        cells[k, PLACE + entry] += count * middle[entry]
        cells[k, PLACE + 2 + entry] += count * (middle[entry] ** 2 + spread)
