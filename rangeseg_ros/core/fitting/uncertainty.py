"""How far fitted planes may be off: sandwich covariances from the sensor's errors.

These errors are white, or Gaussian fields of correlation exp(-|i - j|^2 / (4 sigma^2)), with
sigma the width of the kernel they look smoothed with. Sums over pairs of pixels are taken over
pairs of cells, with a Gaussian of the variance of their places: these have a closed form.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.fitting.region_sums import PLACE, RAY, WEIGHT, RegionSums
from rangeseg_ros.core.sensing.moments import COLUMNS, COUNT, ROWS, SYMMETRIC, sum_by_label
from rangeseg_ros.core.sensing.sensor import FLOOR, SensorModel, random_variance

# Standard deviations of a correlation beyond which it is zero.
_FAR = 5.0


def covariance_roots(
    sums: RegionSums, level: Floats, inverse: Floats, sensor: SensorModel
) -> Floats:
    """Roots (M + 1, 3, 3) of the covariances of planes theta . ray = inverse range of regions.

    `level` (N,) are the inverse ranges of cells on them, see `levels`, and `inverse`
    (M + 1, 3, 3) is A^-1. Zeros where there is no plane.
    """
    smooth = 1 - sensor.white if sensor.correlation > 0 else 0.0
    noise = smooth * (FLOOR + sensor.noise**2), smooth * sensor.range_noise**2
    distortion = sensor.distortion**2, sensor.range_distortion**2
    # Squares of the same scale as the rays: variance times weight.
    white = (1 - smooth) * random_variance(sensor, level**2)
    white *= sums.cells[:, WEIGHT] / sums.cells[:, COUNT]
    total = sum_by_label(sums.owners, white[:, None] * sums.cells[:, :6], len(inverse))
    middle = total[:, SYMMETRIC]
    place = sums.cells[:, PLACE : PLACE + 4] / sums.cells[:, COUNT, None]
    place[:, 2:] = np.maximum(place[:, 2:] - place[:, :2] ** 2, 0)
    for field in ((sensor.correlation, *noise), (sensor.distortion_length, *distortion)):
        if field[1] + field[2] > 0:
            # float(): integers in a SensorModel would compile the kernel once more.
            half = _halves(sums, level, place, *map(float, field))
            middle += half + half.transpose(0, 2, 1)
    return roots(inverse, middle)


def levels(sums: RegionSums, theta: Floats) -> Floats:
    """Inverse ranges (N,) of the planes of regions at the middles of their cells."""
    plane, rays = theta[sums.owners], sums.cells[:, RAY : RAY + 3]
    total: Floats = (plane * rays).sum(axis=1)
    return total / sums.cells[:, WEIGHT]


def roots(outer: Floats, middle: Floats) -> Floats:
    """R (N, m, 3) with R R^T = outer middle outer^T, of `outer` (N, m, 3) and `middle` (N, 3, 3).

    No rounding error that `outer` magnifies can make R R^T negative. Directions whose variance is
    not positive after rounding are left out.
    """
    return outer @ _cholesky(middle)


@njit(cache=True, nogil=True)
def _cholesky(matrices: Floats) -> Floats:
    """Lower triangles L (N, 3, 3) with L L^T the matrices."""
    factor = np.zeros_like(matrices)
    for k in range(len(matrices)):
        for p in range(3):
            for q in range(p + 1):
                rest = matrices[k, p, q]
                for r in range(q):
                    rest -= factor[k, p, r] * factor[k, q, r]
                if p == q:
                    factor[k, p, p] = np.sqrt(max(rest, 0.0))
                elif factor[k, q, q] > 0:
                    factor[k, p, q] = rest / factor[k, q, q]
    return factor


def squares(root: Floats) -> Floats:
    """Covariances R R^T, (N, m, m), of roots R (N, m, 3)."""
    result: Floats = (root[:, :, None] * root[:, None]).sum(axis=3)
    return result


def plane_jacobians(normal: Floats, distance: Floats) -> Floats:
    """Derivative (N, 4, 3) of (normal, distance) by theta = -normal / distance."""
    tangent = np.eye(3) - normal[:, :, None] * normal[:, None]
    along = distance[:, None, None] ** 2 * normal[:, None]
    return np.concatenate([-distance[:, None, None] * tangent, along], axis=1)


@njit(cache=True, nogil=True)
def _halves(
    sums: RegionSums, level: Floats, place: Floats, width: float, constant: float, quartic: float
) -> Floats:
    """Halves of the sums over pairs of pixels (M + 1, 3, 3) of regions: but for the transposes.

    Of a Gaussian field that looks smoothed with a kernel of this width, pixels, and has the
    variance constant + quartic y^4. `place` (N, 4) are the mean row and column of the pixels of
    cells, and their variances.
    """
    result = np.zeros((len(sums.start) - 1, 3, 3))
    variance, ray = 2 * width**2, np.empty((len(level), 3))
    for k in range(len(result)):
        begin, end = sums.start[k], sums.start[k + 1]
        for i in range(begin, end):
            cell, own = sums.cells[i], constant + quartic * level[i] ** 4
            for p in range(3):
                ray[i, p] = np.sqrt(own) * cell[RAY + p]
            # The part of the field that varies within the cell.
            total = (variance + 2 * place[i, 2]) * (variance + 2 * place[i, 3])
            shared = max(cell[COUNT] * variance / np.sqrt(max(total, 1e-300)), 1.0)
            spread = (place[i, 2] + place[i, 3]) / 2
            own *= spread / max(variance + spread, 1e-300) * shared * cell[WEIGHT] / cell[COUNT]
            for entry in range(6):
                p, q = ROWS[entry], COLUMNS[entry]
                centred = cell[entry] - cell[RAY + p] * cell[RAY + q] / cell[WEIGHT]
                result[k, p, q] += own * centred / (1 + (p == q))
        for i in range(begin, end):
            x = y = z = 0.0
            for j in range(i, end):
                down = variance + place[i, 2] + place[j, 2]
                across = variance + place[i, 3] + place[j, 3]
                lag = (place[i, 0] - place[j, 0]) ** 2 / max(down, 1e-300)
                lag += (place[i, 1] - place[j, 1]) ** 2 / max(across, 1e-300)
                if lag > _FAR**2:
                    continue
                shared = variance / np.sqrt(max(down * across, 1e-300)) * np.exp(-lag / 2)
                if lag == 0:
                    # A pixel agrees with itself.
                    shared = max(shared, 1 / min(sums.cells[i, COUNT], sums.cells[j, COUNT]))
                shared /= 1 + (i == j)
                x, y, z = x + shared * ray[j, 0], y + shared * ray[j, 1], z + shared * ray[j, 2]
            for p in range(3):
                result[k, p, 0] += ray[i, p] * x
                result[k, p, 1] += ray[i, p] * y
                result[k, p, 2] += ray[i, p] * z
    return result
