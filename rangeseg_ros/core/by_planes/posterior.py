"""Whether a region is a plane or a curved surface, as a probability.

What a quadratic explains of the residuals of a plane, its bend, has three terms. Noise, the smooth
distortion of the sensor and the bend of the surface itself make it, and each term is Gaussian with
the sum of their variances. The last is log-normal; the posterior compares planes with curved
surfaces, the likelihood of each integrated over it (Gauss-Hermite quadrature) and over what makes
large blocks bend. Regions of one curved surface that touch leave their planes along their crease.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Indices, Labels
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
from rangeseg_ros.core.sensing.moments import COUNT, cofactors, squares_left, sums_of
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    distortion_share,
    random_variance,
    systematic_variance,
)

# Medians and logarithmic standard deviations, by maximum likelihood over 96 planes and curved
# regions of 17 annotated frames of 12 sensors: bend over width of planes and of curved surfaces,
# root mean square. The curved ones are wider spread than those of the frames, which were cut in
# pieces (0.013, 0.5): whole curved objects of simulated scenes bend by up to 0.1.
PLANE_BEND = 0.0023
_PLANE, _CURVED = (PLANE_BEND, 0.5), (0.02, 0.9)
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)
# Logistic regression (Platt 1999) of planes among 246 regions of 20 annotated frames of 16 cameras
# on the log-odds of their bend: slope, and odds where the bend tells nothing.
_SLOPE, _ODDS = 2.6, 0.1
# Share of their crease by which parts of curved surfaces leave their planes: that of quadratics is
# 0.94, in the median of simulated cylinders and balls, which bend most at the limb, it is 0.4.
_FOLLOWED = 0.5
# Largest exponent whose power is finite.
_FINITE = float(np.log(np.finfo(float).max))


def calibrated(posterior: Floats) -> Floats:
    """Share (...,) of planes among regions whose bend makes them planes by a `posterior` (...,).

    Where it tells little, most are clutter: that is smooth in pieces, too.
    """
    with np.errstate(divide='ignore'):
        return np.asarray(1 / (1 + ((1 - posterior) / posterior) ** _SLOPE / _ODDS))


def plane_posteriors(fits: Fits, pairs: Labels) -> Floats:
    """Posterior probability (M + 1,) of each region to be a plane and no curved surface.

    By its bend, with even odds before, and by those of `pairs` (E, 2) of regions that touch: they
    may be parts of one surface, as facets of a cylinder are. 0 for region 0.
    """
    # Fitted anew, in inverse range: the planes of clouds are of total least squares, and what they
    # leave in inverse range would look like a bend. A plane of a scanner is not linear in pixels.
    known = fits.total, fit_sums(fits.total), fits.sensor, fits.sensor.region_inflation
    # Of a pair the larger region first, whose numbers are lower: places are told from its middle.
    return _posteriors(fits.sums, np.sort(pairs).astype(np.intp), *known)


@njit(cache=True, nogil=True)
def _posteriors(
    sums: RegionSums,
    pairs: Indices,
    total: Floats,
    theta: Floats,
    sensor: SensorModel,
    region_inflation: float,
) -> Floats:
    alone = np.zeros(len(theta))
    for k in range(1, len(theta)):
        alone[k] = _posterior(sums, k, total[k], theta[k], sensor, region_inflation)
    result = alone.copy()
    for e in range(len(pairs)):
        a, b = pairs[e, 0], pairs[e, 1]
        if not (theta[a].any() and theta[b].any()):
            continue
        # If both are curved, they are parts of one surface: the evidence of that counts there.
        odds = _evidence(sums, a, b, theta, sensor, region_inflation)
        ratio = np.exp(min(max(odds, -_FINITE), _FINITE))
        for k, other in ((a, b), (b, a)):
            curved = (1 - alone[k]) * (alone[other] + (1 - alone[other]) * ratio)
            result[k] = min(result[k], alone[k] / (alone[k] + curved))
    return result


# Divisions by zero give inf: cells through which the plane passes edge on.
@njit(cache=True, error_model='numpy')
def _posterior(
    sums: RegionSums,
    k: int,
    total: Floats,
    theta: Floats,
    sensor: SensorModel,
    region_inflation: float,
) -> float:
    """Posterior probability of a region to be a plane, by its bend alone."""
    if not theta.any():
        return 0.5
    size, square, linear, bend, scale, ratio = _residuals(sums, k, theta, sensor)
    # Noise as the region itself shows it: at a grazing angle it is more than the sensor's.
    noise = region_inflation * max((square - linear - bend) / size, 1.0)
    distortion = ratio * distortion_share(size, max(sensor.distortion_length**2, 1.0)) * size / 3
    # Sum of squares, for each of the three terms, of a bend as large as the region is wide.
    width = _area(total) * size / (3 * scale**2)
    plane = curved = 0.0
    # Large blocks bend more because the sensor bends planes smoothly, or because surfaces bend.
    for part in (1.0, sensor.unbent):
        known = noise + part * distortion
        plane += _likelihood(bend, known, width, _PLANE)
        curved += _likelihood(bend, known, width, _CURVED)
    return plane / (plane + curved) if plane + curved > 0 else 0.0


@njit(cache=True, error_model='numpy')
def _residuals(
    sums: RegionSums, k: int, theta: Floats, sensor: SensorModel
) -> tuple[float, float, float, float, float, float]:
    """What a plane leaves of a region, in standard deviations of the noise of a pixel.

    Number of pixels, sum of the squared residuals, of what a linear fit to the means of cells
    explains of them, and of what the other terms of a quadratic add; mean standard deviation
    across the plane, metres, and mean ratio of the variances of distortion and noise.
    """
    system = np.zeros((7, 6))
    size = square = scale = ratio = 0.0
    plane = theta[0], theta[1], theta[2]
    slope = np.sqrt(theta[0] ** 2 + theta[1] ** 2 + theta[2] ** 2)
    for i in range(sums.start[k], sums.start[k + 1]):
        cell, left = sums.cells[i], squares_left(sums_of(sums.cells, i), plane)
        count = cell[COUNT]
        mean, level, variance = _mean(cell, theta, sensor)
        _add_terms(system, _terms(cell, sums.box[k]), mean, count)
        size += count
        # Weights of a cloud are not those of its errors.
        unit = count / (variance * cell[WEIGHT])
        square += max(left, 0.0) * unit
        # An error of the inverse leaves the plane by distance / inverse times as much.
        scale += count * np.sqrt(variance) / (slope * abs(level))
        ratio += count * systematic_variance(sensor, level**2) / variance
    linear, bend = _explained(system)
    return size, square, linear, bend, scale / size, ratio / size


@njit(cache=True, error_model='numpy')
def _evidence(
    sums: RegionSums, a: int, b: int, theta: Floats, sensor: SensorModel, region_inflation: float
) -> float:
    """Log-likelihood ratio that regions a and b follow one curved surface, against planes of each.

    The quadratic that is nearest to both planes differs from these by a crease. Parts of a curved
    surface leave their planes along it, planes by noise, as large as the plane leaves it. A test
    of separate hypotheses (Cox, Proc. 4th Berkeley Symp. Math. Stat. Prob. 1, 1961).
    """
    system, odds = np.zeros((7, 6)), 0.0
    for cell in sums.cells[sums.start[b] : sums.start[b + 1]]:
        apart = _mean(cell, theta[a], sensor)[0] - _mean(cell, theta[b], sensor)[0]
        _add_terms(system, _terms(cell, sums.box[a]), apart, cell[COUNT])
    for cell in sums.cells[sums.start[a] : sums.start[a + 1]]:
        _add_terms(system, _terms(cell, sums.box[a]), 0.0, cell[COUNT])
    _explained(system)
    quadratic = _solution(system)
    for part in range(2):
        k, cells, size, square, along, left = (a, b)[part], 0, 0.0, 0.0, 0.0, 0.0
        for cell in sums.cells[sums.start[k] : sums.start[k + 1]]:
            own, count = _mean(cell, theta[k], sensor)[0], cell[COUNT]
            terms = _terms(cell, sums.box[a])
            crease = part * (_mean(cell, theta[a], sensor)[0] - own)
            for c in range(6):
                crease -= quadratic[c] * terms[c]
            crease *= _FOLLOWED
            cells, size, left = cells + 1, size + count, left + count * own**2
            square, along = square + count * crease**2, along - count * crease * own
        # Along a crease as along any quadratic, large planes leave more, as they are distorted.
        smooth = max(2 * distortion_share(size, max(sensor.distortion_length**2, 1.0)), 1.0)
        odds += (along - square / 2) / (smooth * max(region_inflation, left / max(cells - 3, 1)))
    return odds


@njit(cache=True)
def _terms(cell: Floats, box: Indices) -> tuple[float, ...]:
    """Terms of a quadratic at the mean place of a cell; about 1 within a bounding box."""
    half = max(box[2] - box[0], box[3] - box[1]) / 2
    v = (cell[PLACE] / cell[COUNT] - (box[0] + box[2]) / 2) / half
    u = (cell[PLACE + 1] / cell[COUNT] - (box[1] + box[3]) / 2) / half
    return 1.0, u, v, u * u, u * v, v * v


@njit(cache=True, error_model='numpy')
def _mean(cell: Floats, theta: Floats, sensor: SensorModel) -> tuple[float, float, float]:
    """Mean residual of a cell from a plane, in standard deviations; its level and variance."""
    level = 0.0
    for a in range(3):
        level += theta[a] * cell[RAY + a]
    variance = random_variance(sensor, (level / cell[WEIGHT]) ** 2)
    mean = (cell[INVERSE] - level) / (cell[WEIGHT] * np.sqrt(variance))
    return mean, level / cell[WEIGHT], variance


@njit(cache=True)
def _add_terms(system: Floats, terms: tuple[float, ...], value: float, weight: float) -> None:
    """Add an equation to the normal equations of a fit, in place; see `_explained`."""
    for a in range(6):
        system[6, a] += weight * terms[a] * value
        for b in range(a + 1):
            system[a, b] += weight * terms[a] * terms[b]


@njit(cache=True)
def _explained(root: Floats) -> tuple[float, float]:
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
def _solution(root: Floats) -> Floats:
    """Coefficients (6,) of the fit, of what `_explained` leaves."""
    result = np.zeros(6)
    for a in range(5, -1, -1):
        value = root[6, a]
        for b in range(a + 1, 6):
            value -= root[b, a] * result[b]
        result[a] = value / root[a, a]
    return result


@njit(cache=True)
def _area(total: Floats) -> float:
    """Area of the rectangle whose points have the same covariance, square metres."""
    n, s = total[COUNT], SCATTER
    x, y, z = total[POINT] / n, total[POINT + 1] / n, total[POINT + 2] / n
    a, b, c = total[s] / n - x * x, total[s + 1] / n - x * y, total[s + 2] / n - x * z
    d, e, f = total[s + 3] / n - y * y, total[s + 4] / n - y * z, total[s + 5] / n - z * z
    aa, _, _, dd, _, ff, _ = cofactors(a, b, c, d, e, f)
    # The product of the two larger eigenvalues: there is hardly a third one.
    return 12 * np.sqrt(max(aa + dd + ff, 0.0))


@njit(cache=True)
def _likelihood(bend: float, known: float, width: float, surface: tuple[float, float]) -> float:
    """Density of three squared Gaussian terms that sum to `bend`, but for a common factor."""
    total = 0.0
    for a in range(len(_NODES)):
        own = surface[0] * np.exp(surface[1] * _NODES[a])
        variance = known + width * own * own
        total += _WEIGHTS[a] * variance**-1.5 * np.exp(-bend / (2 * variance))
    return total
