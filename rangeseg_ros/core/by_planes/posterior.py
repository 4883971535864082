"""Whether a region is a plane or a curved surface, as a probability.

What a quadratic explains of the residuals of a plane, its bend, has three terms. Noise, the smooth
distortion of the sensor and the bend of the surface itself make it, and each term is Gaussian with
the sum of their variances. The last two are log-normal; the posterior compares planes with curved
surfaces, the likelihood of each integrated over these (Gauss-Hermite quadrature).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.region_sums import (
    INVERSE,
    PLACE,
    POINT,
    RAY,
    SCATTER,
    WEIGHT,
    RegionSums,
    fit_sums,
)
from rangeseg_ros.core.sensing.moments import COUNT, cofactors, squares_left
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    distortion_share,
    random_variance,
    systematic_variance,
)

# Medians and logarithmic standard deviations, by maximum likelihood over 96 planes and curved
# regions of 17 annotated frames of 12 sensors: bend over width of planes and of curved surfaces,
# root mean square; and the deviation of the distortion's share. The curved ones are wider spread
# than those of the frames, which were cut in pieces (0.013, 0.5): whole curved objects of
# simulated scenes bend by up to 0.1.
PLANE_BEND = 0.0023
_PLANE, _CURVED, _SPREAD = (PLANE_BEND, 0.5), (0.02, 0.9), 0.32
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


def plane_probabilities(fits: Fits, prior: float) -> NDArray[np.float64]:
    """Posterior probability (M + 1,) of each region to be a plane and no curved surface.

    `prior` is the share of planes among regions: the result where nothing tells. 0 for region 0.
    """
    sums, sensor = fits.sums, fits.sensor
    around, alike = float(max(sensor.distortion_pixels, 1)), float(sensor.correlated)
    # The planes of least squares in inverse range: what those of clouds leave, which are of total
    # least squares, is no bend to a scanner, whose planes are not linear in the pixels.
    theta = fit_sums(fits.total)
    return _probabilities(sums, fits.total, theta, sensor, around, alike, prior)


# Divisions by zero give inf: cells through which the plane passes edge on.
@njit(cache=True, nogil=True, error_model='numpy')
def _probabilities(
    sums: RegionSums,
    total: NDArray[np.float64],
    theta: NDArray[np.float64],
    sensor: SensorModel,
    around: float,
    alike: float,
    prior: float,
) -> NDArray[np.float64]:
    result = np.zeros(len(theta))
    for k in range(1, len(theta)):
        result[k] = prior
        if not theta[k].any():
            continue
        cells = sums.cells[sums.start[k] : sums.start[k + 1]]
        shown = _residuals(cells, theta[k], sensor, sums.box[k])
        size, square, linear, bend, scale, ratio = shown
        if size == 0:  # all its pixels are too far from the plane
            continue
        # Noise as the region itself shows it: at a grazing angle it is more than the sensor's.
        noise = alike * max((square - linear - bend) / size, 1.0)
        distortion = ratio * distortion_share(size, around) * size / 3
        # Sum of squares, for each of the three terms, of a bend as large as the region is wide.
        width = _area(total[k]) * size / (3 * scale**2)
        plane = prior * _likelihood(bend, noise, distortion, width, _PLANE)
        curved = (1 - prior) * _likelihood(bend, noise, distortion, width, _CURVED)
        result[k] = plane / (plane + curved) if plane + curved > 0 else 0.0
    return result


@njit(cache=True, error_model='numpy')
def _residuals(
    cells: NDArray[np.float64],
    theta: NDArray[np.float64],
    sensor: SensorModel,
    box: NDArray[np.intp],
) -> tuple[float, float, float, float, float, float]:
    """What a plane leaves of a region, in standard deviations of the noise of a pixel.

    Number of pixels, sum of the squared residuals, of what a linear fit to the means of cells
    explains of them, and of what the other terms of a quadratic add; mean standard deviation
    across the plane, metres, and mean ratio of the variances of distortion and noise.
    """
    system = np.zeros((7, 6))
    size = square = scale = ratio = 0.0
    slope = np.sqrt(theta[0] ** 2 + theta[1] ** 2 + theta[2] ** 2)
    half = max(box[2] - box[0], box[3] - box[1]) / 2
    for cell in cells:
        count, level, mean = cell[COUNT], 0.0, cell[INVERSE]
        for a in range(3):
            level += theta[a] * cell[RAY + a]
            mean -= theta[a] * cell[RAY + a]
        level /= cell[WEIGHT]
        variance = random_variance(sensor, level**2)
        # Weights of a cloud are not those of its errors.
        unit = count / (variance * cell[WEIGHT])
        mean /= cell[WEIGHT] * np.sqrt(variance)
        v = (cell[PLACE] / count - (box[0] + box[2]) / 2) / half
        u = (cell[PLACE + 1] / count - (box[1] + box[3]) / 2) / half
        terms = 1.0, u, v, u * u, u * v, v * v
        for a in range(6):
            system[6, a] += count * terms[a] * mean
            for b in range(a + 1):
                system[a, b] += count * terms[a] * terms[b]
        size += count
        square += max(squares_left(cell, theta), 0.0) * unit
        # An error of the inverse leaves the plane by distance / inverse times as much.
        scale += count * np.sqrt(variance) / (slope * abs(level))
        ratio += count * systematic_variance(sensor, level**2) / variance
    linear, bend = _explained(system)
    return size, square, linear, bend, scale / size, ratio / size


@njit(cache=True)
def _explained(root: NDArray[np.float64]) -> tuple[float, float]:
    """Sums of squares that the linear terms of a fit explain, and that its quadratic ones add.

    Of the normal equations A = L L^T (Cholesky) with b below, where b^T A^-1 b is |L^-1 b|^2, and
    the first terms have the first rows to themselves. L takes the place of A, L^-1 b that of b.
    """
    ridge, linear, bend = 1e-9 * max(root[0, 0], 1.0), 0.0, 0.0
    for a in range(7):
        for b in range(min(a + 1, 6)):
            for c in range(b):
                root[a, b] -= root[a, c] * root[b, c]
            if a == b:
                root[a, a] = np.sqrt(max(root[a, a], 0.0) + ridge)
            else:
                root[a, b] /= root[b, b]
    for a in range(3):
        linear, bend = linear + root[6, a] ** 2, bend + root[6, 3 + a] ** 2
    return linear, bend


@njit(cache=True)
def _area(total: NDArray[np.float64]) -> float:
    """Area of the rectangle whose points have the same covariance, square metres."""
    n, s = total[COUNT], SCATTER
    x, y, z = total[POINT] / n, total[POINT + 1] / n, total[POINT + 2] / n
    a, b, c = total[s] / n - x * x, total[s + 1] / n - x * y, total[s + 2] / n - x * z
    d, e, f = total[s + 3] / n - y * y, total[s + 4] / n - y * z, total[s + 5] / n - z * z
    aa, _, _, dd, _, ff, _ = cofactors(a, b, c, d, e, f)
    # The product of the two larger eigenvalues: there is hardly a third one.
    return 12 * np.sqrt(max(aa + dd + ff, 0.0))


@njit(cache=True)
def _likelihood(
    bend: float, noise: float, distortion: float, width: float, surface: tuple[float, float]
) -> float:
    """Density of three squared Gaussian terms that sum to `bend`, but for a common factor."""
    total = 0.0
    for a in range(len(_NODES)):
        shown = distortion * np.exp(_SPREAD * _NODES[a])
        for b in range(len(_NODES)):
            own = surface[0] * np.exp(surface[1] * _NODES[b])
            variance = noise + shown + width * own * own
            total += _WEIGHTS[a] * _WEIGHTS[b] * variance**-1.5 * np.exp(-bend / (2 * variance))
    return total
