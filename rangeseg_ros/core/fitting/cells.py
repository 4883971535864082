"""Sums over the cells of regions: all that planes and their uncertainty need of the pixels.

Each region's bounding box is cut into at most `MOST` square cells. What is linear in the pixels,
like a fit, adds up over cells; what couples pairs of pixels, like correlated noise, couples pairs
of cells instead.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.interior import rows_of_blocks
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import BLOCK, Blocks
from rangeseg_ros.core.sensing.moments import CHI2, COUNT, squares_left
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    random_variance,
    systematic_variance,
)

MOST = 100
"""Cells of a region at most."""
WEIGHTED_RAY, WEIGHT, POINT, SCATTER, RECORD = 12, 15, 16, 19, 25
"""Entries of a cell after its moment vector, which lacks w y^2 and the variance ratio: w r (3), w,
p (3), p p^T (6); their number."""
# Standard deviations of random and systematic error beyond which a pixel is an outlier.
_OUTLIER = 4.0
# Pixels from another region up to which a pixel may be its neighbour's.
_RIM = 2


class Cells(NamedTuple):
    """Regions 0...M cut into cells; region 0 has none.

    Attributes
    ----------
    box : (M + 1, 4) int
        First row and column of each region, and the ones after its last; zeros without pixels.
    border : (M + 1,) int
        Sides of pixels where a region ends.
    size : (M + 1,) int
        Rows and columns of a region's cells.
    columns : (M + 1,) int
        Cells side by side.
    start : (M + 2,) int
        Where each region's cells begin in `sums`.
    inner : (rows, columns) uint16
        Region of each block of 4 x 4 pixels that its cells take as a whole, 0 for the others.
    sums : (N, 25) float64
        A moment vector and the entries after it, for each cell.
    """

    box: NDArray[np.intp]
    border: NDArray[np.intp]
    size: NDArray[np.intp]
    columns: NDArray[np.intp]
    start: NDArray[np.intp]
    inner: NDArray[np.uint16]
    sums: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        labels: NDArray[np.uint16],
        image: RangeImage,
        sensor: SensorModel,
        blocks: Blocks,
        inner: NDArray[np.uint16],
    ) -> Cells:
        """Sums over all measured pixels.

        Parameters
        ----------
        labels : (H, W) uint16
            0...M.
        image : RangeImage
            (H, W).
        sensor : SensorModel
        blocks : Blocks
            Of the image.
        inner : (rows, columns) uint16
            Region of each block inside it, see `interior`.
        """
        box, border = bounding_boxes(labels, int(labels.max(initial=0)) + 1)
        rows, columns = box[:, 2] - box[:, 0], box[:, 3] - box[:, 1]
        size = np.maximum(np.ceil(np.sqrt(rows * columns / MOST)).astype(np.intp), 1)
        while (large := -(-rows // size) * -(-columns // size) > MOST).any():
            size += large
        rows, columns = -(-rows // size), -(-columns // size)
        start = np.concatenate([[0], np.cumsum(rows * columns)])
        central = image.camera is not None
        # Small cells need the pixels, as blocks do not end where they do, and so do rays that have
        # no z of 1.
        taken = (size >= 2 * BLOCK) & central
        inner = np.where(taken[inner], inner, np.uint16(0))
        cells = cls(box, border, size, columns, start, inner, np.zeros((start[-1], RECORD)))
        arrays = labels, image.inverse, image.rays, blocks
        upper, lower = map_halves(_sums, len(labels), *arrays, cells, sensor, central)
        return cells._replace(sums=upper + lower)

    def without_doubtful(
        self,
        labels: NDArray[np.uint16],
        image: RangeImage,
        theta: NDArray[np.float64],
        sensor: SensorModel,
        blocks: Blocks,
    ) -> tuple[Cells, NDArray[np.intp], NDArray[np.float64]]:
        """Leave out of the sums what may not belong to regions: outliers, then rims.

        Outliers are the pixels that the planes `theta` (M + 1, 3) do not explain. A region keeps
        them where they are more than half of it, as it is then the sensor model that does not
        fit, and its rim, where that would take the rest to less than half.

        Returns
        -------
        cells : Cells
        outliers : (M + 1,) int
            Number of outliers, whether left out or kept.
        explained : (M + 1, 25) float64
            Sums over whole regions, with their rims.
        """
        central = image.camera is not None
        arrays = labels, image.inverse, image.rays, blocks
        parts = map_halves(_doubtful, len(labels), *arrays, self, sensor, theta, central)
        (pixels, outliers, rims), outlying, rim = (a + b for a, b in zip(*parts, strict=True))
        region = np.repeat(np.arange(len(self.size)), np.diff(self.start))
        few = 2 * outliers <= pixels
        cells = self._replace(sums=self.sums - outlying * few[region, None])
        explained = cells.regions()
        few = 2 * (outliers + rims) <= pixels
        return cells._replace(sums=cells.sums - rim * few[region, None]), outliers, explained

    def regions(self) -> NDArray[np.float64]:
        """Sums over whole regions, (M + 1, 25)."""
        total = np.zeros((len(self.size), RECORD))
        filled = np.flatnonzero(np.diff(self.start))
        if len(filled):
            total[filled] = np.add.reduceat(self.sums, self.start[filled])
        return total


@njit(cache=True)
def bounding_boxes(
    labels: NDArray[np.integer], count: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Bounding box of each label and the number of pixel sides along its border."""
    height, width = labels.shape
    box = np.zeros((count, 4), np.intp)
    border = np.zeros(count, np.intp)
    for i in range(height):
        before = 0
        for j in range(width):
            label = int(labels[i, j])
            above = int(labels[i - 1, j]) if i > 0 else 0
            if label != above:
                border[label] += 1
                border[above] += 1
            if label != before:
                border[label] += 1
                border[before] += 1
                _reach(box[before], i, j)
                if label > 0:
                    if box[label, 3] == 0:
                        box[label, 0], box[label, 1] = i, j
                    box[label, 1] = min(box[label, 1], j)
            before = label
        _reach(box[before], i, width)
        border[before] += 1
    for j in range(width):
        border[labels[height - 1, j]] += 1
    box[0] = 0
    return box, border


@njit(cache=True)
def _reach(box: NDArray[np.intp], row: int, after: int) -> None:
    """Let a box reach to a row, and to the column before `after`."""
    box[2] = max(box[2], row + 1)
    box[3] = max(box[3], after)


@njit(cache=True)
def _index(cells: Cells, label: int, i: int, j: int) -> int:
    """Cell of a pixel."""
    size = cells.size[label]
    row, column = (i - cells.box[label, 0]) // size, (j - cells.box[label, 1]) // size
    return int(cells.start[label] + row * cells.columns[label] + column)


@njit(cache=True, inline='always')
def _add(
    record: NDArray[np.float64],
    i: int,
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    sensor: SensorModel,
    central: bool,
) -> None:
    """Add pixels `first` to before `after` of row `i` to a cell."""
    # In variables of their own: sums in an array would go through memory for every pixel.
    a = b = c = d = e = f = p = q = r = count = w0 = w1 = w2 = weight = 0.0
    z0 = z1 = z2 = z00 = z01 = z02 = z11 = z12 = z22 = 0.0
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
        x0, x1, x2 = float(rays[i, j, 0]), float(rays[i, j, 1]), float(rays[i, j, 2])
        wx0, wx1, wx2 = w * x0, w * x1, w * x2
        w0, w1, w2 = w0 + wx0, w1 + wx1, w2 + wx2
        a, b, c = a + wx0 * x0, b + wx0 * x1, c + wx0 * x2
        d, e, f = d + wx1 * x1, e + wx1 * x2, f + wx2 * x2
        p, q, r = p + wx0 * y, q + wx1 * y, r + wx2 * y
        z = 1 / y
        x0, x1, x2 = z * x0, z * x1, z * x2
        z0, z1, z2 = z0 + x0, z1 + x1, z2 + x2
        z00, z01, z02 = z00 + x0 * x0, z01 + x0 * x1, z02 + x0 * x2
        z11, z12, z22 = z11 + x1 * x1, z12 + x1 * x2, z22 + x2 * x2
    moments = (a, b, c, d, e, f, p, q, r, 0.0, count, 0.0, w0, w1, w2, weight)
    for entry, value in enumerate(moments):
        record[entry] += value
    for entry, value in enumerate((z0, z1, z2, z00, z01, z02, z11, z12, z22)):
        record[POINT + entry] += value


@njit(cache=True, inline='always')
def _add_block(
    record: NDArray[np.float64], moments: NDArray[np.float64], squared: float, sensor: SensorModel
) -> None:
    """Add a block, of moments with unit weights, to a cell: its rays have z = 1."""
    w = 1 / random_variance(sensor, squared)
    for entry in range(CHI2):
        record[entry] += w * moments[entry]
    record[COUNT] += moments[COUNT]
    for entry, place in enumerate((2, 4, 5)):
        record[WEIGHTED_RAY + entry] += w * moments[place]
    record[WEIGHT] += w * moments[COUNT]
    # With 1 / y^2 for weights, sums of r y and r r^T are those of points and of their squares.
    w = 1 / squared
    for entry in range(3):
        record[POINT + entry] += w * moments[6 + entry]
    for entry in range(6):
        record[SCATTER + entry] += w * moments[entry]


@njit(cache=True, nogil=True)
def _sums(
    top: int,
    bottom: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    blocks: Blocks,
    cells: Cells,
    sensor: SensorModel,
    central: bool,
) -> NDArray[np.float64]:
    """Sums (N, 25) over the measured pixels of some rows."""
    sums = np.zeros_like(cells.sums)
    inner, width = cells.inner, labels.shape[1]
    first_block, after_block = rows_of_blocks(top, bottom)
    for bi in range(first_block, after_block):
        for bj in range(inner.shape[1]):
            if inner[bi, bj] > 0 and blocks.moments[bi, bj, COUNT] > 0:
                middle = bi * BLOCK + BLOCK // 2, bj * BLOCK + BLOCK // 2
                record = sums[_index(cells, inner[bi, bj], *middle)]
                _add_block(record, blocks.moments[bi, bj], blocks.squared[bi, bj], sensor)
    for i in range(top, bottom):
        within = inner[i // BLOCK]
        j = 0
        while j < width:
            first, label = j, labels[i, j]
            if label == 0:
                j += 1
                continue
            if within[j // BLOCK] > 0:
                j = (j // BLOCK + 1) * BLOCK
                continue
            left, size = cells.box[label, 1], cells.size[label]
            end = min(left + ((j - left) // size + 1) * size, width)
            while j < end and labels[i, j] == label and within[j // BLOCK] == 0:
                j += 1
            record = sums[_index(cells, label, i, first)]
            _add(record, i, first, j, inverse, rays, sensor, central)
    return sums


@njit(cache=True, nogil=True)
def _doubtful(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    blocks: Blocks,
    cells: Cells,
    sensor: SensorModel,
    theta: NDArray[np.float64],
    central: bool,
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Outliers and the rest of the rims among some rows.

    The numbers of all pixels, of outliers and of the rest of the rim, (3, M + 1), and the sums
    over either, (N, 25).
    """
    inner, (height, width) = cells.inner, labels.shape
    count = np.zeros((3, len(theta)), np.intp)
    outlying, rim = np.zeros_like(cells.sums), np.zeros_like(cells.sums)
    explained = np.zeros(inner.shape, np.bool_)
    first_block, after_block = rows_of_blocks(first, after)
    for bi in range(max(first_block - 1, 0), after_block):
        for bj in range(inner.shape[1]):
            label, squared = inner[bi, bj], blocks.squared[bi, bj]
            if label == 0:
                continue
            variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
            # No pixel is farther off than all together.
            left = squares_left(blocks.moments[bi, bj], theta[label])
            explained[bi, bj] = left <= _OUTLIER**2 * variance
            if explained[bi, bj] and bi >= first_block:
                count[0, label] += int(blocks.moments[bi, bj, COUNT])
    for i in range(first, after):
        above, below = max(i - _RIM, 0), min(i + _RIM, height - 1)
        within = explained[i // BLOCK]
        j = -1
        while j + 1 < width:
            j += 1
            if within[j // BLOCK]:
                j = (j // BLOCK + 1) * BLOCK - 1
                continue
            label = int(labels[i, j])
            y = float(inverse[i, j])
            if label == 0 or y == 0:
                continue
            count[0, label] += 1
            # No views of a ray and a plane: their references would be counted for every pixel.
            residual = y - theta[label, 0] * rays[i, j, 0] - theta[label, 1] * rays[i, j, 1]
            residual -= theta[label, 2] * rays[i, j, 2]
            squared = y * y
            variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
            if residual * residual > _OUTLIER**2 * variance:
                count[1, label] += 1
                sums = outlying
            elif inner[i // BLOCK, j // BLOCK] > 0:
                continue
            else:
                left, right = max(j - _RIM, 0), min(j + _RIM, width - 1)
                if (
                    labels[above, left] == label
                    and labels[above, right] == label
                    and labels[below, left] == label
                    and labels[below, right] == label
                ):
                    continue
                count[2, label] += 1
                sums = rim
            record = sums[_index(cells, label, i, j)]
            _add(record, i, j, j + 1, inverse, rays, sensor, central)
    return count, outlying, rim
