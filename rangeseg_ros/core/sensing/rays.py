"""Rays of pixels that measured nothing, where an image does not tell them.

A cloud has points, and no rays where there are none. Those of a camera or a scanner change so
smoothly over its grid that a polynomial through those that are known tells the others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.range_image import RangeImage

_DEGREE = 6  # of the polynomial: unit vectors over 120 degrees, to a hundredth of a pixel
_GRID = 80  # rows and columns of the grid of pixels that it is fitted to, at most
_SMOOTH = 0.5  # largest error, in pixels, of a grid that is smooth


def completed_rays(image: RangeImage) -> tuple[NDArray[np.float32], NDArray[np.bool_]] | None:
    """Rays (H, W, 3) of a cloud; None where their grid is not smooth.

    And the pixels (H, W) with measured ones on either side, in their row or column: beyond these,
    a polynomial goes anywhere. Within, rays are those measured, and unit vectors elsewhere.
    """
    valid = image.valid
    down, across = (max(size // _GRID, 1) for size in image.shape)
    rows, columns = np.nonzero(valid[::down, ::across])
    rows, columns = rows * down, columns * across
    neighbours = valid[:, 1:] & valid[:, :-1]
    if len(rows) < 10 * (_DEGREE + 1) ** 2 or not neighbours.any():
        return None
    known = image.rays[rows, columns].astype(np.float64)
    basis = _basis(rows, columns, image.shape)
    coefficients = np.linalg.lstsq(basis, known, rcond=None)[0]
    error = np.linalg.norm(basis @ coefficients - known, axis=1)
    pixel = np.median(np.linalg.norm(np.diff(image.rays, axis=1)[neighbours], axis=1))
    if np.quantile(error, 0.95) > _SMOOTH * pixel:
        return None
    between = np.zeros_like(valid)
    for axis in (0, 1):
        before = np.logical_or.accumulate(valid, axis)
        between |= before & np.flip(np.logical_or.accumulate(np.flip(valid, axis), axis), axis)
    rows, columns = np.nonzero(between & ~valid)
    rays = image.rays.copy()
    found = _basis(rows, columns, image.shape) @ coefficients
    rays[rows, columns] = found / np.linalg.norm(found, axis=1, keepdims=True)
    return rays, between


def _basis(
    rows: NDArray[np.intp], columns: NDArray[np.intp], shape: tuple[int, int]
) -> NDArray[np.floating]:
    """(N, M) Chebyshev polynomials of both coordinates."""
    v, u = (2 * x / max(size - 1, 1) - 1 for x, size in zip((rows, columns), shape, strict=True))
    basis: NDArray[np.floating] = np.polynomial.chebyshev.chebvander2d(v, u, [_DEGREE, _DEGREE])
    return basis
