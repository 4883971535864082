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

from rangeseg_ros.core.meaning.cells import Cells, CellSize
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.moments import cofactors

# Cells of a block, which is about square.
_ROWS, _COLUMNS = 16, 2
# The prior counts as so much of a window full of ground: each of the about five levels leaves a
# fifth of what the one before has left.
_PRIOR = 0.25


def ground_field(
    cells: Cells, on_ground: NDArray[np.bool_], base: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Planes theta of the ground: theta . ray is its inverse range.

    Parameters
    ----------
    cells : Cells
        (rows, columns).
    on_ground : (rows, columns) bool
        Cells that are ground.
    base : (3,) float64
        Plane under the robot.

    Returns
    -------
    (M, N, 3) float64, one for each block of the image.
    """
    levels = [_moments(cells.ray, cells.inverse, on_ground)]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halved(levels[-1]))
    theta = np.asarray(base, np.float64)[None, None]
    for sums in reversed(levels):
        theta = _fitted(sums, theta)
    return theta


@njit(cache=True, nogil=True)
def _moments(
    ray: NDArray[np.float32], inverse: NDArray[np.float32], on_ground: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Sums over blocks: ray ray^T (6), ray * inverse (3) of the ground; ray ray^T of all (6)."""
    rows, columns = on_ground.shape
    sums = np.zeros((-(-rows // _ROWS), -(-columns // _COLUMNS), 15))
    for i in range(rows):
        for c in range(columns):
            value = inverse[i, c]
            if value == 0:
                continue
            total = sums[i // _ROWS, c // _COLUMNS]
            x, y, z = ray[i, c, 0], ray[i, c, 1], ray[i, c, 2]
            xx, xy, xz, yy, yz, zz = x * x, x * y, x * z, y * y, y * z, z * z
            total[9] += xx
            total[10] += xy
            total[11] += xz
            total[12] += yy
            total[13] += yz
            total[14] += zz
            if on_ground[i, c]:
                total[0] += xx
                total[1] += xy
                total[2] += xz
                total[3] += yy
                total[4] += yz
                total[5] += zz
                total[6] += x * value
                total[7] += y * value
                total[8] += z * value
    return sums


def _halved(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of 2 x 2 neighbours."""
    rows, columns = sums.shape[:2]
    padded = np.pad(sums, ((0, rows % 2), (0, columns % 2), (0, 0)))
    return padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]


@njit(cache=True, nogil=True)
def _fitted(sums: NDArray[np.float64], prior: NDArray[np.float64]) -> NDArray[np.float64]:
    """Planes that fit the ground in windows of 3 x 3 blocks, and all rays on the prior planes.

    `prior` has a plane for 2 x 2 blocks.
    """
    rows, columns = sums.shape[:2]
    theta = np.empty((rows, columns, 3))
    window = np.empty(15)
    for i in range(rows):
        for j in range(columns):
            p = prior[min(i // 2, prior.shape[0] - 1), min(j // 2, prior.shape[1] - 1)]
            theta[i, j] = p
            window[:] = 0
            for m in range(max(i - 1, 0), min(i + 2, rows)):
                for n in range(max(j - 1, 0), min(j + 2, columns)):
                    for k in range(15):
                        window[k] += sums[m, n, k]
            g = window
            if g[0] + g[3] + g[5] == 0:
                continue
            a, b, c = g[0] + _PRIOR * g[9], g[1] + _PRIOR * g[10], g[2] + _PRIOR * g[11]
            d, e, f = g[3] + _PRIOR * g[12], g[4] + _PRIOR * g[13], g[5] + _PRIOR * g[14]
            # What the ground is off the prior plane.
            x = g[6] - g[0] * p[0] - g[1] * p[1] - g[2] * p[2]
            y = g[7] - g[1] * p[0] - g[3] * p[1] - g[4] * p[2]
            z = g[8] - g[2] * p[0] - g[4] * p[1] - g[5] * p[2]
            aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
            if determinant <= 1e-13 * a * d * f:
                continue
            theta[i, j, 0] += (aa * x + bb * y + cc * z) / determinant
            theta[i, j, 1] += (bb * x + dd * y + ee * z) / determinant
            theta[i, j, 2] += (cc * x + ee * y + ff * z) / determinant
    return theta


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
    result = np.full(cells.inverse.shape, np.nan, np.float32)
    run_rows(_cell_heights, len(result), cells, field, size, result)
    return result


@njit(cache=True, nogil=True)
def _cell_heights(
    first: int,
    after: int,
    cells: Cells,
    field: GroundField,
    size: CellSize,
    result: NDArray[np.float32],
) -> None:
    line = np.empty((field.theta.shape[1], 4))
    for i in range(first, after):
        planes_of_row(field, (i + 0.5) * size.rows - 0.5, line)
        for c in range(result.shape[1]):
            value = cells.inverse[i, c]
            if value > 0:
                x = (c + 0.5) * size.columns / field.columns - 0.5
                result[i, c] = height_in_row(line, x, value, cells.ray[i, c])


@njit(cache=True, inline='always')
def planes_of_row(field: GroundField, row: float, line: NDArray[np.float64]) -> None:
    """Planes theta of the ground at a row of the image, and theta . up, one for each block."""
    theta, up = field.theta, field.up
    y = min(max((row + 0.5) / field.rows - 0.5, 0.0), theta.shape[0] - 1.0)
    i = int(y)
    k, v = min(i + 1, theta.shape[0] - 1), y - i
    for j in range(theta.shape[1]):
        for n in range(3):
            line[j, n] = (1 - v) * theta[i, j, n] + v * theta[k, j, n]
        line[j, 3] = line[j, 0] * up[0] + line[j, 1] * up[1] + line[j, 2] * up[2]


@njit(cache=True, inline='always')
def height_in_row(
    line: NDArray[np.float64], x: float, inverse: float, ray: NDArray[np.float32]
) -> float:
    """Height of a point above the plane theta . p = 1 at x, in blocks, along up."""
    x = min(max(x, 0.0), line.shape[0] - 1.0)
    j = int(x)
    k, u = min(j + 1, line.shape[0] - 1), x - j
    theta = (
        line[j, 0] + u * (line[k, 0] - line[j, 0]),
        line[j, 1] + u * (line[k, 1] - line[j, 1]),
        line[j, 2] + u * (line[k, 2] - line[j, 2]),
    )
    along = theta[0] * ray[0] + theta[1] * ray[1] + theta[2] * ray[2]
    rise = line[j, 3] + u * (line[k, 3] - line[j, 3])
    return (along - inverse) / (inverse * rise)


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
