r"""How far fitted planes may be off: covariances from the sensor's errors.

A weighted fit of theta . r = y turns errors e of the inverse range into
A^-1 sum_i w_i r_i e_i, with A = sum_i w_i r_i r_i^T, whence the sandwich

    cov(theta) = A^-1 (sum_ij w_i w_j r_i r_j^T cov(e_i, e_j)) A^-1.

The sensor's errors are white, or Gaussian fields of correlation exp(-|i - j|^2 / (4 sigma^2)),
sigma the width of the kernel they look smoothed with. Their sum over pairs of pixels is taken over
pairs of cells, one axis after the other; where cells are wider than the field, as a sum
over the pixels of which each counts for the number that agree with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.cells import WEIGHT, WEIGHTED_RAY, Cells, is_empty, level_of
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.sensor import (
    FLOOR,
    SensorModel,
    random_variance,
    systematic_variance,
)

# Widths of a field that a cell may span and still be treated as a unit.
_FINE = 2.0


class Field(NamedTuple):
    """Gaussian random field of variance constant + quartic y^4 at the inverse range y.

    `width` is that of the kernel it looks smoothed with, pixels.
    """

    width: float
    constant: float
    quartic: float


def systematic_field(sensor: SensorModel) -> Field:
    """The smooth errors of a sensor."""
    return Field(
        sensor.distortion_length, np.square(sensor.distortion), np.square(sensor.range_distortion)
    )


def theta_covariances(
    cells: Cells,
    theta: NDArray[np.float64],
    inverse: NDArray[np.float64],
    sensor: SensorModel,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Covariance of each plane in the form theta . ray = inverse range, and the sum within it.

    Parameters
    ----------
    cells : Cells
        Of M + 1 regions.
    theta : (M + 1, 3) float64
        Their planes; zeros where there is none.
    inverse : (M + 1, 3, 3) float64
        A^-1.
    sensor : SensorModel

    Returns
    -------
    (M + 1, 3, 3) float64
        The covariances; zeros where there is no plane.
    (M + 1, 3, 3) float64
        The sums over pairs of pixels between A^-1 and A^-1.
    """
    random = Field(
        sensor.correlation, FLOOR + np.square(sensor.noise), np.square(sensor.range_noise)
    )
    fields = random, systematic_field(sensor)
    result = np.zeros_like(inverse), np.zeros_like(inverse)
    map_halves(_covariances, len(theta), cells, theta, inverse, sensor, *fields, *result)
    return result


@njit(cache=True, nogil=True)
def sandwiches(outer: NDArray[np.float64], middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """outer middle outer^T, (N, m, m), of `outer` (N, m, 3) and covariances `middle` (N, 3, 3)."""
    result = np.empty((len(outer), outer.shape[1], outer.shape[1]))
    for k in range(len(outer)):
        sandwich(outer[k], middle[k], result[k])
    return result


@njit(cache=True)
def sandwich(
    outer: NDArray[np.float64], middle: NDArray[np.float64], result: NDArray[np.float64]
) -> None:
    """outer middle outer^T, to `result` (m, m), of `outer` (m, 3) and a covariance (3, 3).

    By a root of it, so that no rounding that `outer` magnifies makes a variance negative.
    """
    root = _root(middle)
    along = np.zeros((len(outer), 3))
    for a in range(len(outer)):
        for b in range(3):
            for c in range(3):
                along[a, b] += outer[a, c] * root[c, b]
    for a in range(len(outer)):
        for b in range(a, len(outer)):
            result[a, b] = result[b, a] = (along[a] * along[b]).sum()


@njit(cache=True)
def _root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """A matrix that makes a covariance (3, 3) times its transpose (Cholesky, with pivots).

    What rounding has made of directions without variance is left out.
    """
    left, root = covariance.copy(), np.zeros((3, 3))
    for step in range(3):
        pivot = 0
        for a in range(1, 3):
            if left[a, a] > left[pivot, pivot]:
                pivot = a
        if left[pivot, pivot] <= 0:
            break
        scale = 1 / np.sqrt(left[pivot, pivot])
        for a in range(3):
            root[a, step] = scale * left[a, pivot]
        for a in range(3):
            for b in range(3):
                left[a, b] -= root[a, step] * root[b, step]
        for a in range(3):
            left[a, pivot] = left[pivot, a] = 0
    return root


@njit(cache=True)
def plane_jacobians(
    normal: NDArray[np.float64], distance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivative (N, 4, 3) of (normal, distance) by theta = -normal / distance."""
    jacobian = np.empty((len(normal), 4, 3))
    for k in range(len(normal)):
        for a in range(3):
            for b in range(3):
                tangent = (1.0 if a == b else 0.0) - normal[k, a] * normal[k, b]
                jacobian[k, a, b] = -distance[k] * tangent
            jacobian[k, 3, a] = distance[k] ** 2 * normal[k, a]
    return jacobian


@njit(cache=True, nogil=True)
def _covariances(
    first: int,
    after: int,
    cells: Cells,
    theta: NDArray[np.float64],
    inverse: NDArray[np.float64],
    sensor: SensorModel,
    random: Field,
    systematic: Field,
    covariance: NDArray[np.float64],
    middle: NDArray[np.float64],
) -> None:
    """What `theta_covariances` returns, of the regions from the first to before the second.

    More than seven parameters: the first two are the share of a thread, and the errors of the
    sensor are two fields.
    """
    white = sensor.white if sensor.correlation > 0 else 1.0
    for k in range(max(first, 1), after):
        if not theta[k].any():
            continue
        own = cells.sums[cells.start[k] : cells.start[k + 1]]
        random_square = np.zeros((3, 3))
        systematic_square = np.zeros((3, 3))
        count = 0.0
        for c in range(len(own)):
            if is_empty(own[c]):
                continue
            count += own[c, COUNT]
            # Squares of the same scale as the rays: variance times weight.
            level = level_of(own[c], theta[k])
            mean = own[c, WEIGHT] / own[c, COUNT]
            of_random = mean * random_variance(sensor, level**2)
            of_systematic = mean * systematic_variance(sensor, level**2)
            entry = 0
            for a in range(3):
                for b in range(a, 3):
                    random_square[a, b] += of_random * own[c, entry]
                    systematic_square[a, b] += of_systematic * own[c, entry]
                    entry += 1
        for a in range(3):
            for b in range(a):
                random_square[a, b] = random_square[b, a]
                systematic_square[a, b] = systematic_square[b, a]
        result = white * random_square
        # Sides of pixels overstate the length of a border by 4 / pi on average.
        share = np.pi / 4 * cells.border[k] / max(count, 1.0)
        if white < 1:
            result += (1 - white) * _field(cells, k, theta[k], random, random_square, share)
        if systematic.constant + systematic.quartic > 0:
            result += _field(cells, k, theta[k], systematic, systematic_square, share)
        middle[k] = result
        sandwich(inverse[k], result, covariance[k])


@njit(cache=True)
def _field(
    cells: Cells,
    k: int,
    theta: NDArray[np.float64],
    field: Field,
    square: NDArray[np.float64],
    border: float,
) -> NDArray[np.float64]:
    """Sum over pairs of pixels of region `k`.

    `square` is the sum over the single pixels, `border` the length of border per pixel.
    """
    if cells.size[k] <= _FINE * field.width:
        return pairs(cells, k, theta, k, theta, field)
    # Along each row and column, as many pixels agree as the correlation sums to.
    line = 1.0
    for lag in range(1, int(8 * field.width) + 2):
        if field.width > 0:
            line += 2 * np.exp(-((lag / field.width) ** 2) / 4)
    # Those within width / sqrt(pi) of the border miss half of them on average.
    inside = max(1 - border * field.width / np.sqrt(np.pi), 0.5)
    return max(line * line * inside, 1.0) * square


@njit(cache=True)
def pairs(
    cells: Cells,
    a: int,
    theta_a: NDArray[np.float64],
    b: int,
    theta_b: NDArray[np.float64],
    field: Field,
) -> NDArray[np.float64]:
    """Sum over pairs of pixels, the first of region a, the second of b, (3, 3)."""
    rays_a, rays_b = _scaled_rays(cells, a, theta_a, field), _scaled_rays(cells, b, theta_b, field)
    along = _correlation(cells, a, b, rays_a.shape[1], rays_b.shape[1], 1, field.width)
    down = _correlation(cells, a, b, rays_a.shape[0], rays_b.shape[0], 0, field.width)
    # First the columns, then the rows: cubes instead of fourth powers of the grid's side.
    half = np.zeros((rays_b.shape[0], rays_a.shape[1], 3))
    for i in range(rays_b.shape[0]):
        for j in range(rays_b.shape[1]):
            for m in range(rays_a.shape[1]):
                for p in range(3):
                    half[i, m, p] += along[m, j] * rays_b[i, j, p]
    result = np.zeros((3, 3))
    seen = np.zeros(3)
    for i in range(rays_a.shape[0]):
        for j in range(rays_a.shape[1]):
            seen[:] = 0
            for m in range(rays_b.shape[0]):
                for p in range(3):
                    seen[p] += down[i, m] * half[m, j, p]
            for p in range(3):
                for q in range(3):
                    result[p, q] += rays_a[i, j, p] * seen[q]
    return result


@njit(cache=True)
def _scaled_rays(
    cells: Cells, k: int, theta: NDArray[np.float64], field: Field
) -> NDArray[np.float64]:
    """Sums of weighted rays times the field's standard deviation, (rows, columns, 3)."""
    own = cells.sums[cells.start[k] : cells.start[k + 1]]
    columns = cells.columns[k]
    rays = np.zeros((len(own) // columns, columns, 3))
    for c in range(len(own)):
        if not is_empty(own[c]):
            level = level_of(own[c], theta)
            deviation = np.sqrt(field.constant + field.quartic * level**4)
            for p in range(3):
                rays[c // columns, c % columns, p] = deviation * own[c, WEIGHTED_RAY + p]
    return rays


@njit(cache=True)
def _correlation(
    cells: Cells, a: int, b: int, count_a: int, count_b: int, axis: int, width: float
) -> NDArray[np.float64]:
    """Mean correlation between the pixels of two rows of cells, (count_a, count_b)."""
    size_a, size_b = cells.size[a], cells.size[b]
    # The offsets within both cells widen the correlation by their variances.
    variance = 2 * width**2
    wide = variance + (size_a**2 + size_b**2 - 2) / 12
    gain = np.sqrt(variance / wide)
    result = np.empty((count_a, count_b))
    for i in range(count_a):
        for j in range(count_b):
            if a == b and min(i, j) > 0:
                result[i, j] = result[i - 1, j - 1]
                continue
            lag = cells.origin[a, axis] + (i + 0.5) * size_a
            lag -= cells.origin[b, axis] + (j + 0.5) * size_b
            result[i, j] = gain * np.exp(-(lag**2) / (2 * wide))
    return result
