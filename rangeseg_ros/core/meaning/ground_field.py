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
from rangeseg_ros.core.runtime.threads import strips

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
    levels = [_moments(cells, on_ground)]
    while max(levels[-1][0].shape[:2]) > 1:
        ground, every = levels[-1]
        levels.append((_halved(ground), _halved(every)))
    theta = np.asarray(base, np.float64)[None, None]
    for ground, every in reversed(levels):
        rows, columns = ground.shape[:2]
        parents = theta[np.arange(rows)[:, None] // 2, np.arange(columns) // 2]
        theta = _fitted(_window(ground), _window(every), parents)
    return theta


@njit(cache=True, nogil=True)
def _moments(
    cells: Cells, on_ground: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums of ray ray^T (6) and ray * inverse (3): of the ground, and the first of all cells."""
    rows, columns = on_ground.shape
    blocks = -(-rows // _ROWS), -(-columns // _COLUMNS)
    ground = np.zeros((*blocks, 9))
    every = np.zeros((*blocks, 6))
    for i in range(rows):
        for c in range(columns):
            value = cells.inverse[i, c]
            if value == 0:
                continue
            m, n = i // _ROWS, c // _COLUMNS
            x, y, z = cells.ray[i, c]
            for k, product in enumerate((x * x, x * y, x * z, y * y, y * z, z * z)):
                every[m, n, k] += product
                if on_ground[i, c]:
                    ground[m, n, k] += product
            if on_ground[i, c]:
                ground[m, n, 6] += x * value
                ground[m, n, 7] += y * value
                ground[m, n, 8] += z * value
    return ground, every


def _halved(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of 2 x 2 neighbours."""
    rows, columns = sums.shape[:2]
    padded = np.pad(sums, ((0, rows % 2), (0, columns % 2), (0, 0)))
    return padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]


def _window(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of 3 x 3 neighbours."""
    padded = np.pad(sums, ((1, 1), (1, 1), (0, 0)))
    tall = padded[:-2] + padded[1:-1] + padded[2:]
    return tall[:, :-2] + tall[:, 1:-1] + tall[:, 2:]


@njit(cache=True, nogil=True)
def _fitted(
    ground: NDArray[np.float64], every: NDArray[np.float64], prior: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Planes that fit the moments of the ground, and those of all rays on the prior planes."""
    theta = prior.copy()
    for i in range(ground.shape[0]):
        for j in range(ground.shape[1]):
            g, p = ground[i, j], prior[i, j]
            if g[0] + g[3] + g[5] == 0:
                continue
            a, b, c, d, e, f = g[:6] + _PRIOR * every[i, j]
            # What the ground is off the prior plane.
            x = g[6] - g[0] * p[0] - g[1] * p[1] - g[2] * p[2]
            y = g[7] - g[1] * p[0] - g[3] * p[1] - g[4] * p[2]
            z = g[8] - g[2] * p[0] - g[4] * p[1] - g[5] * p[2]
            aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
            dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
            determinant = a * aa + b * bb + c * cc
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
    strips(_cell_heights, len(result), cells, field, size, result)
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
    for i in range(first, after):
        for c in range(result.shape[1]):
            if cells.inverse[i, c] > 0:
                row, column = (i + 0.5) * size.rows - 0.5, (c + 0.5) * size.columns - 0.5
                theta = plane_at(field, row, column)
                result[i, c] = height_above(theta, cells.inverse[i, c], cells.ray[i, c], field.up)


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


@njit(cache=True, inline='always')
def height_above(
    theta: tuple[float, float, float],
    inverse: float,
    ray: NDArray[np.float32],
    up: NDArray[np.float64],
) -> float:
    """Height of the point above the plane theta . p = 1, along up."""
    along = theta[0] * ray[0] + theta[1] * ray[1] + theta[2] * ray[2]
    rise = theta[0] * up[0] + theta[1] * up[1] + theta[2] * up[2]
    return (along / inverse - 1) / rise
