"""What bends more than the sensor bends a plane: regions, and those that are facets of a surface.

A curved surface is cut to facets that planes explain, and a narrow facet bends no more than a
plane that the sensor distorts. What it is shows where two touch. A quadratic has six parameters,
as two planes have: of faces that meet in a crease the planes leave less, of facets the quadratic.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.quadratics import explained, fitted, taken_off
from rangeseg_ros.core.fitting.borders import Borders
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.significance import chi2_quantile

# The distortion of real Kinects over planes of A pixels, measured on hand-annotated frames, has a
# quarter of its overall standard deviation over a square as wide as itself and grows as A^0.39.
# Real planes stay within two and a half times that, and the distortion is measured to within a
# tenth.
_SHARE, _EXPONENT = 0.75**2, 0.78
# Chi-squared of three terms of curvature, for pixels whose noise is independent.
_CHI2_LIMIT = chi2_quantile(3, 0.99)


class Residuals(NamedTuple):
    """What planes leave of regions 0...M, in standard deviations of the noise of a pixel.

    Attributes
    ----------
    powers, right : (M + 1, 15), (M + 1, 6) float64
        Normal equations of a quadratic in the pixel coordinates, see `quadratics`.
    square : (M + 1,) float64
        Sum of squares.
    area, scale : (M + 1,) float64
        Sums of the area of each pixel on the plane, square metres, and of its standard deviation
        across it, metres.
    covered : (M + 1,) float64
        Number of pixels, holes included.
    ratio : (M + 1,) float64
        Of the variances of distortion and noise.
    """

    powers: NDArray[np.float64]
    right: NDArray[np.float64]
    square: NDArray[np.float64]
    area: NDArray[np.float64]
    scale: NDArray[np.float64]
    covered: NDArray[np.float64]
    ratio: NDArray[np.float64]


class Allowed(NamedTuple):
    """What a plane may bend by.

    Attributes
    ----------
    around : float
        Pixels that the distortion is alike around.
    alike : float
        Pixels whose noise is alike.
    flatness : float
        Share of its width that a plane may bend by, root mean square.
    """

    around: float
    alike: float
    flatness: float


@njit(cache=True, nogil=True)
def find_bent(residuals: Residuals, allowed: Allowed) -> NDArray[np.bool_]:
    """Which regions (M + 1,) bend by more than distortion and noise do, and than is allowed."""
    result = np.zeros(len(residuals.covered), np.bool_)
    for k in range(1, len(result)):
        result[k] = _bends(residuals, k, allowed)
    return result


@njit(cache=True, nogil=True)
def find_facets(
    bent: NDArray[np.bool_],
    borders: Borders,
    residuals: Residuals,
    allowed: Allowed,
    planes: NDArray[np.float64],
    sensor: SensorModel,
) -> NDArray[np.bool_]:
    """Which regions are bent, or facets of a surface that is.

    Two are facets of one where they touch along the width of the smaller, bend together, and one
    quadratic leaves significantly less than their two planes, of neither significantly more than
    its own plane. Beside what bends, less is enough.

    Parameters
    ----------
    bent : (M + 1,) bool
        Regions that bend by themselves.
    borders : Borders
        Of the regions.
    residuals : Residuals
        Of the regions.
    allowed : Allowed
    planes : (M + 1, 3) float64
        The inverse range of each plane at the origin of the pixel coordinates of `Residuals`,
        and its changes along x and y, linear for a pinhole camera.
    sensor : SensorModel

    Returns
    -------
    (M + 1,) bool
    """
    result, count = bent.copy(), len(borders.other)
    one = np.empty(count, np.intp)
    possible, sure = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for k in range(len(result)):
        for e in range(borders.start[k], borders.start[k + 1]):
            m, one[e] = borders.other[e], k
            width = np.sqrt(min(residuals.covered[k], residuals.covered[m]))
            if k < m and borders.links[e] >= max(width, borders.cuts[e]):
                possible[e], sure[e] = _one_surface(k, m, residuals, allowed, planes, sensor)
    found = True
    while found:
        found = False
        for e in range(count):
            k, m = one[e], borders.other[e]
            if sure[e] or (possible[e] and (result[k] or result[m])):
                found |= not (result[k] and result[m])
                result[k] = result[m] = True
    return result


@njit(cache=True)
def _one_surface(
    k: int,
    m: int,
    residuals: Residuals,
    allowed: Allowed,
    planes: NDArray[np.float64],
    sensor: SensorModel,
) -> tuple[bool, bool]:
    """Whether one quadratic explains two regions beside what bends, and whether anywhere."""
    powers, right, square, area, scale, covered, ratio = residuals
    # What the plane of the one leaves of the other is linear, and the noise about the same in it.
    size, linear = max(powers[m, 0], 1.0), np.zeros(6)
    level = planes[m, 0] + (planes[m, 1] * powers[m, 1] + planes[m, 2] * powers[m, 5]) / size
    linear[:3] = (planes[k] - planes[m]) / np.sqrt(random_variance(sensor, level**2))
    moved = taken_off(powers[m], right[m], square[m], linear)
    weighed = covered[k] * ratio[k] + covered[m] * ratio[m]
    both = Residuals(
        (powers[k] + powers[m]).reshape(1, -1),
        (right[k] + moved[0]).reshape(1, -1),
        np.full(1, square[k] + moved[1]),
        np.full(1, area[k] + area[m]),
        np.full(1, scale[k] + scale[m]),
        np.full(1, covered[k] + covered[m]),
        np.full(1, weighed / (covered[k] + covered[m])),
    )
    if not _bends(both, 0, allowed):
        return False, False
    quadratic = fitted(both.powers[0], both.right[0])
    chance = _chance(both, 0, allowed)
    gain = 0.0
    for part, own, total in ((k, right[k], square[k]), (m, *moved)):
        left = taken_off(powers[part], own, total, quadratic)[1]
        more = left - square[part] + explained(powers[part], right[part])[0]
        if more > chance:
            return False, False
        gain -= more
    return gain > 0, gain > chance


@njit(cache=True)
def _bends(residuals: Residuals, k: int, allowed: Allowed) -> bool:
    """Whether region k bends by more than distortion and noise do, and than is allowed."""
    size, covered = max(residuals.powers[k, 0], 1.0), residuals.covered[k]
    # What the quadratic explains more than its constant and linear terms do.
    bending = explained(residuals.powers[k], residuals.right[k])[1] / size
    chance = _chance(residuals, k, allowed) / size
    visible = bending > _distortion(residuals, k, allowed) + chance
    wide = allowed.flatness**2 * residuals.area[k] * covered / size
    return visible and bending * (residuals.scale[k] / size) ** 2 > wide


@njit(cache=True)
def _distortion(residuals: Residuals, k: int, allowed: Allowed) -> float:
    """Mean square by which the sensor bends a plane seen as region k."""
    return _SHARE * residuals.ratio[k] * (residuals.covered[k] / allowed.around) ** _EXPONENT


@njit(cache=True)
def _chance(residuals: Residuals, k: int, allowed: Allowed) -> float:
    """Sum of squares that curvature explains of noise alone, at most."""
    # Noise as the region itself shows it: at a grazing angle it is more than the sensor's.
    left = residuals.square[k] - sum(explained(residuals.powers[k], residuals.right[k]))
    return allowed.alike * _CHI2_LIMIT * max(left / max(residuals.powers[k, 0], 1.0), 1.0)
