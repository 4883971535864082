r"""How far fitted planes may be off: covariances from the sensor's errors.

A weighted fit of theta . r = y turns errors e of the inverse range into
A^-1 sum_i w_i r_i e_i, with A = sum_i w_i r_i r_i^T, whence the sandwich

    cov(theta) = A^-1 (sum_ij w_i w_j r_i r_j^T cov(e_i, e_j)) A^-1.

The sensor's errors are white, or Gaussian fields of correlation exp(-|i - j|^2 / (4 sigma^2)),
sigma the width of the kernel they look smoothed with. Their sum over pairs of pixels is taken over
pairs of cells: pixels of a cell spread around its middle like a Gaussian of their variance, over
which the mean of the correlation has a closed form.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.region_sums import PLACE, RAY, WEIGHT, RegionSums
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.sensor import FLOOR, SensorModel, random_variance

# Standard deviations of a correlation beyond which it is zero.
_FAR = 5.0
# Of a row of `field_units`: mean row and column, their variances, pixels, the deviation and the
# weighted ray (3) times it.
_UNIT = 9


class Field(NamedTuple):
    """Gaussian random field of variance constant + quartic y^4 at the inverse range y.

    `width` is that of the kernel it looks smoothed with, pixels.
    """

    width: float
    constant: float
    quartic: float


def distortion_field(sensor: SensorModel) -> Field:
    """The smooth systematic errors of a sensor."""
    # A model whose numbers are given as integers is one of numbers all the same.
    return Field(
        *map(float, (sensor.distortion_length, sensor.distortion**2, sensor.range_distortion**2))
    )


def theta_covariances(
    sums: RegionSums, theta: NDArray[np.float64], inverse: NDArray[np.float64], sensor: SensorModel
) -> NDArray[np.float64]:
    """Covariance of each plane in the form theta . ray = inverse range.

    Parameters
    ----------
    sums : RegionSums
        Of M + 1 regions.
    theta : (M + 1, 3) float64
        Their planes; zeros where there is none.
    inverse : (M + 1, 3, 3) float64
        A^-1.
    sensor : SensorModel

    Returns
    -------
    (M + 1, 3, 3) float64
        Zeros where there is no plane.
    """
    smooth = 1 - sensor.white if sensor.correlation > 0 else 0.0
    variances = smooth * (FLOOR + sensor.noise**2), smooth * sensor.range_noise**2
    random = Field(*map(float, (sensor.correlation, *variances)))
    fields = random, distortion_field(sensor)
    result = np.zeros_like(inverse)
    map_halves(_covariances, len(theta), sums, theta, inverse, sensor, 1 - smooth, *fields, result)
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
    sums: RegionSums,
    theta: NDArray[np.float64],
    inverse: NDArray[np.float64],
    sensor: SensorModel,
    white: float,
    random: Field,
    distortion: Field,
    result: NDArray[np.float64],
) -> None:
    """What `theta_covariances` returns, of the regions from the first to before the second."""
    for k in range(max(first, 1), after):
        if not theta[k].any():
            continue
        cells = sums.cells[sums.start[k] : sums.start[k + 1]]
        middle = np.zeros((3, 3))
        for c in range(len(cells)):
            if is_empty(cells[c]):
                continue
            # Squares of the same scale as the rays: variance times weight.
            variance = white * random_variance(sensor, level_of(cells[c], theta[k]) ** 2)
            _add_symmetric(middle, cells[c], variance * cells[c, WEIGHT] / cells[c, COUNT], False)
        for field in (random, distortion):
            if field.constant + field.quartic > 0:
                _add_field(middle, cells, theta[k], field)
        sandwich(inverse[k], middle, result[k])


@njit(cache=True)
def _add_symmetric(
    middle: NDArray[np.float64], cell: NDArray[np.float64], factor: float, centred: bool
) -> None:
    """Add so many times the sum of w r r^T of a cell, around its mean ray where `centred`."""
    entry = 0
    for a in range(3):
        for b in range(a, 3):
            value = cell[entry]
            if centred:
                value -= cell[RAY + a] * cell[RAY + b] / cell[WEIGHT]
            middle[a, b] += factor * value
            if a != b:
                middle[b, a] += factor * value
            entry += 1


@njit(cache=True)
def _add_field(
    middle: NDArray[np.float64],
    cells: NDArray[np.float64],
    theta: NDArray[np.float64],
    field: Field,
) -> None:
    """Add the sum over pairs of pixels of a region."""
    middle += common_errors(cells, theta, cells, theta, field)
    variance = 2 * field.width**2
    for c in range(len(cells)):
        if is_empty(cells[c]):
            continue
        # Within a cell the error varies as far as the field is narrower.
        unit = np.empty(_UNIT)
        _fill_unit(unit, cells[c], theta, field)
        spread = (unit[2] + unit[3]) / 2
        alike = unit[4] * _mean_correlation(unit, unit, field.width)
        share = spread / (variance + spread) if spread > 0 else 0.0
        mean = cells[c, WEIGHT] / cells[c, COUNT]
        _add_symmetric(middle, cells[c], share * alike * unit[5] ** 2 * mean, True)


@njit(cache=True)
def common_errors(
    cells_a: NDArray[np.float64],
    theta_a: NDArray[np.float64],
    cells_b: NDArray[np.float64],
    theta_b: NDArray[np.float64],
    field: Field,
) -> NDArray[np.float64]:
    """Sum over pairs of pixels (3, 3), the first of region a, the second of b: of cells' means."""
    units_a, units_b = _units(cells_a, theta_a, field), _units(cells_b, theta_b, field)
    result, seen = np.zeros((3, 3)), np.zeros(3)
    for i in range(len(units_a)):
        seen[:] = 0
        for j in range(len(units_b)):
            correlation = _mean_correlation(units_a[i], units_b[j], field.width)
            if correlation > 0:
                for p in range(3):
                    seen[p] += correlation * units_b[j, 6 + p]
        for p in range(3):
            for q in range(3):
                result[p, q] += units_a[i, 6 + p] * seen[q]
    return result


@njit(cache=True)
def _units(
    cells: NDArray[np.float64], theta: NDArray[np.float64], field: Field
) -> NDArray[np.float64]:
    """Cells as a field sees them, (N, 9), see `_UNIT`."""
    units, count = np.empty((len(cells), _UNIT)), 0
    for c in range(len(cells)):
        if not is_empty(cells[c]):
            _fill_unit(units[count], cells[c], theta, field)
            count += 1
    return units[:count]


@njit(cache=True, inline='always')
def _fill_unit(
    unit: NDArray[np.float64],
    cell: NDArray[np.float64],
    theta: NDArray[np.float64],
    field: Field,
) -> None:
    count = cell[COUNT]
    for axis in range(2):
        unit[axis] = cell[PLACE + axis] / count
        unit[2 + axis] = max(cell[PLACE + 2 + axis] / count - unit[axis] ** 2, 0.0)
    unit[4] = count
    unit[5] = np.sqrt(field.constant + field.quartic * level_of(cell, theta) ** 4)
    for p in range(3):
        unit[6 + p] = unit[5] * cell[RAY + p]


@njit(cache=True, inline='always')
def _mean_correlation(one: NDArray[np.float64], other: NDArray[np.float64], width: float) -> float:
    """Mean correlation between the pixels of two cells; 0 where they are far apart."""
    variance = 2 * width**2
    down, across = variance + one[2] + other[2], variance + one[3] + other[3]
    lag = (one[0] - other[0]) ** 2 / max(down, 1e-300)
    lag += (one[1] - other[1]) ** 2 / max(across, 1e-300)
    if lag > _FAR**2:
        return 0.0
    mean = variance / np.sqrt(max(down * across, 1e-300)) * np.exp(-lag / 2)
    # A pixel agrees with itself.
    return mean if lag > 0 else max(mean, 1 / min(one[4], other[4]))


@njit(cache=True)
def is_empty(cell: NDArray[np.float64]) -> bool:
    """Whether no pixel is in a cell, or none that weighs anything."""
    return cell[COUNT] == 0 or cell[WEIGHT] <= 0


@njit(cache=True)
def level_of(cell: NDArray[np.float64], theta: NDArray[np.float64]) -> float:
    """Inverse range of a plane at the middle of a cell."""
    total = 0.0
    for a in range(3):
        total += theta[a] * cell[RAY + a]
    return total / cell[WEIGHT]
