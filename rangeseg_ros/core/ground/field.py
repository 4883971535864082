"""The ground everywhere in an image: a plane for every block, continued where there is none.

Each block's plane is fitted to the ground in a window around it, with the plane of a window twice
as wide as its prior, up to the whole image and the plane under the robot: where the ground is
seen, the field follows undulation and distortion; where it is not, it goes on straight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.ground.cells import Cells, CellSize
from rangeseg_ros.core.sensing.moments import cofactors

# Cells of a block, which is about square.
_ROWS, _COLUMNS = 8, 2
# The prior counts as so much of a window full of ground: as much as the window is of the one twice
# as wide that the prior is from.
_PRIOR = 1 / 4


@njit(cache=True, nogil=True)
def ground_field(
    ground: NDArray[np.float64], measured: NDArray[np.float64], base: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Planes theta of the ground: theta . ray is its inverse range.

    Parameters
    ----------
    ground, measured : (M, 9, N) float64
        See `sums_of`: of the ground, and of all cells.
    base : (3,) float64
        Plane under the robot.

    Returns
    -------
    (M, N, 3) float64, one for each block of the image.
    """
    # Over blocks, over 2 x 2 blocks, and so on up to the whole image.
    levels = [(ground, measured)]
    while levels[-1][0].size > 9:
        levels.append((_halved(levels[-1][0]), _halved(levels[-1][1])))
    theta = base.copy().reshape(1, 1, 3)
    for k in range(len(levels) - 1, -1, -1):
        theta = _fitted(levels[k][0], levels[k][1], theta)
    return theta


@njit(cache=True, nogil=True)
def sums_of(cells: Cells, where: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Sums of the regression of some measured cells.

    Parameters
    ----------
    cells : Cells
        (rows, columns).
    where : (rows, columns) bool
        Which ones.

    Returns
    -------
    (M, 9, N) float64
        ray ray^T (xx, xy, xz, yy, yz, zz) and ray * inverse over blocks.
    """
    ray, inverse = cells.ray, cells.inverse
    rows, columns = where.shape
    high = -(-rows // _ROWS)
    sums = np.zeros((high, 9, -(-columns // _COLUMNS)))
    # Of the columns by themselves, as vector instructions.
    total = np.empty((9, columns))
    for m in range(high):
        total[:] = 0
        for i in range(m * _ROWS, min((m + 1) * _ROWS, rows)):
            for c in range(columns):
                value = inverse[i, c]
                there = where[i, c] & (value > 0)
                x = ray[0, i, c] if there else np.float32(0)
                y = ray[1, i, c] if there else np.float32(0)
                z = ray[2, i, c] if there else np.float32(0)
                total[0, c] += x * x
                total[1, c] += x * y
                total[2, c] += x * z
                total[3, c] += y * y
                total[4, c] += y * z
                total[5, c] += z * z
                total[6, c] += x * value
                total[7, c] += y * value
                total[8, c] += z * value
        for k in range(9):
            for c in range(columns):
                sums[m, k, c // _COLUMNS] += total[k, c]
    return sums


@njit(cache=True, nogil=True)
def _halved(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of 2 x 2 neighbours."""
    rows, _, columns = sums.shape
    result = np.zeros(((rows + 1) // 2, 9, (columns + 1) // 2))
    for i in range(rows):
        for k in range(9):
            for j in range(columns):
                result[i // 2, k, j // 2] += sums[i, k, j]
    return result


@njit(cache=True, nogil=True, error_model='numpy')
def _fitted(
    sums: NDArray[np.float64], squares: NDArray[np.float64], prior: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Planes that fit the ground in windows of 3 x 3 blocks, and all rays on the prior planes.

    `prior` has a plane for 2 x 2 blocks.
    """
    rows, _, columns = sums.shape
    theta = np.empty((rows, columns, 3))
    # Sums of three blocks above each other, between two that are empty, and of windows.
    high = np.zeros((9, columns + 2))
    g, s = np.empty((2, 9, columns))
    # The prior planes of a row, and what they become.
    above, fit = np.empty((2, 3, columns))
    for i in range(rows):
        _add_around(sums, i, high, g)
        _add_around(squares, i, high, s)
        for j in range(columns):
            p = prior[min(i // 2, prior.shape[0] - 1), min(j // 2, prior.shape[1] - 1)]
            above[0, j], above[1, j], above[2, j] = p[0], p[1], p[2]
        for j in range(columns):
            p, q, r = above[0, j], above[1, j], above[2, j]
            a, b, c = (
                g[0, j] + _PRIOR * s[0, j],
                g[1, j] + _PRIOR * s[1, j],
                g[2, j] + _PRIOR * s[2, j],
            )
            d, e, f = (
                g[3, j] + _PRIOR * s[3, j],
                g[4, j] + _PRIOR * s[4, j],
                g[5, j] + _PRIOR * s[5, j],
            )
            # What the ground is off the prior plane.
            x = g[6, j] - g[0, j] * p - g[1, j] * q - g[2, j] * r
            y = g[7, j] - g[1, j] * p - g[3, j] * q - g[4, j] * r
            z = g[8, j] - g[2, j] * p - g[4, j] * q - g[5, j] * r
            aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
            told = (g[0, j] + g[3, j] + g[5, j] != 0) & (determinant > 1e-13 * a * d * f)
            fit[0, j] = p + (aa * x + bb * y + cc * z) / determinant if told else p
            fit[1, j] = q + (bb * x + dd * y + ee * z) / determinant if told else q
            fit[2, j] = r + (cc * x + ee * y + ff * z) / determinant if told else r
        theta[i] = fit.T
    return theta


@njit(cache=True, inline='always')
def _add_around(
    sums: NDArray[np.float64], i: int, high: NDArray[np.float64], total: NDArray[np.float64]
) -> None:
    """Sums of windows of 3 x 3 blocks around row i, (9, N), by those of three rows, `high`."""
    for k in range(9):
        for j in range(total.shape[1]):
            high[k, j + 1] = 0
        for m in range(max(i - 1, 0), min(i + 2, sums.shape[0])):
            for j in range(total.shape[1]):
                high[k, j + 1] += sums[m, k, j]
        for j in range(total.shape[1]):
            total[k, j] = high[k, j] + high[k, j + 1] + high[k, j + 2]


class GroundField(NamedTuple):
    """Planes of the ground.

    Attributes
    ----------
    theta : (M, N, 3) float64
        theta . ray is the inverse range of the ground at the middle of a block.
    rows, columns : int
        Pixels of a block.
    up : (3,) float64
    """

    theta: NDArray[np.float64]
    rows: int
    columns: int
    up: NDArray[np.float64]

    @classmethod
    def of(
        cls, theta: NDArray[np.float64], size: CellSize, up: NDArray[np.float64]
    ) -> GroundField:
        """With blocks of cells of that size."""
        return cls(theta, _ROWS * size.rows, _COLUMNS * size.columns, up)

    def turned(self) -> GroundField:
        """Of the image with rows and columns exchanged."""
        theta = np.ascontiguousarray(self.theta.transpose(1, 0, 2))
        return GroundField(theta, self.columns, self.rows, self.up)


def cell_heights(cells: Cells, field: GroundField, size: CellSize) -> NDArray[np.float32]:
    """Heights of cells above the ground, metres along up; NaN where nothing is measured."""
    result = np.empty(cells.inverse.shape, np.float32)
    # In units of cells, as if they were pixels.
    small = field._replace(rows=field.rows // size.rows, columns=field.columns // size.columns)
    _cell_heights(cells, small, result)
    return result


@njit(cache=True, nogil=True, error_model='numpy')
def _cell_heights(cells: Cells, field: GroundField, result: NDArray[np.float32]) -> None:
    planes = np.empty((4, result.shape[1]), np.float32)
    spread = spread_planes(field, result.shape[1], 0.0, float(len(result)))
    ray = cells.ray
    for i in range(len(result)):
        planes_of_row(spread, (i + 0.5) / field.rows - 0.5, planes)
        for c in range(result.shape[1]):
            value = cells.inverse[i, c]
            along = (
                planes[0, c] * ray[0, i, c]
                + planes[1, c] * ray[1, i, c]
                + planes[2, c] * ray[2, i, c]
            )
            height = (along - value) / (value * planes[3, c])
            result[i, c] = height if value > 0 else np.float32(np.nan)


@njit(cache=True, nogil=True)
def spread_planes(
    field: GroundField, width: int, top: float, bottom: float
) -> NDArray[np.float32]:
    """Planes of the ground at the columns of an image, (M, 4, width): theta, and theta . up.

    Only of those that rows top...bottom of the image lie between.
    """
    theta, up = field.theta, field.up
    last = theta.shape[1] - 1
    # Blocks beside a column, and how near it is to the right one. As they are not signed, the
    # compiler need not look for negative indices.
    left, right = np.empty((2, width), np.uint64)
    share = np.empty(width)
    for j in range(width):
        x = min(max((j + 0.5) / field.columns - 0.5, 0.0), float(last))
        k = int(x)
        left[j], right[j], share[j] = k, min(k + 1, last), x - k
    result = np.empty((theta.shape[0], 4, width), np.float32)
    planes = np.empty((4, theta.shape[1]))
    first = max(int(top / field.rows - 0.5), 0)
    for i in range(first, min(int(bottom / field.rows + 0.5) + 1, theta.shape[0])):
        for k in range(theta.shape[1]):
            x, y, z = theta[i, k]
            planes[0, k], planes[1, k], planes[2, k] = x, y, z
            planes[3, k] = x * up[0] + y * up[1] + z * up[2]
        for n in range(4):
            for j in range(width):
                value = planes[n, left[j]]
                result[i, n, j] = value + share[j] * (planes[n, right[j]] - value)
    return result


@njit(cache=True, inline='always')
def planes_of_row(spread: NDArray[np.float32], y: float, planes: NDArray[np.float32]) -> None:
    """Planes of the ground (4, width) at y, in rows of blocks, from those of `spread_planes`."""
    y = min(max(y, 0.0), spread.shape[0] - 1.0)
    i = int(y)
    k, v = min(i + 1, spread.shape[0] - 1), np.float32(y - i)
    for n in range(4):
        for j in range(planes.shape[1]):
            planes[n, j] = spread[i, n, j] + v * (spread[k, n, j] - spread[i, n, j])


@njit(cache=True, inline='always')
def plane_at(field: GroundField, row: float, column: float) -> tuple[float, float, float]:
    """Plane of the ground at a pixel, between those of the blocks around it."""
    theta = field.theta
    y = min(max((row + 0.5) / field.rows - 0.5, 0.0), theta.shape[0] - 1.0)
    x = min(max((column + 0.5) / field.columns - 0.5, 0.0), theta.shape[1] - 1.0)
    i, j = int(y), int(x)
    k, m = min(i + 1, theta.shape[0] - 1), min(j + 1, theta.shape[1] - 1)
    v, u = y - i, x - j
    a, b, c, d = (1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u
    return (
        a * theta[i, j, 0] + b * theta[i, m, 0] + c * theta[k, j, 0] + d * theta[k, m, 0],
        a * theta[i, j, 1] + b * theta[i, m, 1] + c * theta[k, j, 1] + d * theta[k, m, 1],
        a * theta[i, j, 2] + b * theta[i, m, 2] + c * theta[k, j, 2] + d * theta[k, m, 2],
    )
