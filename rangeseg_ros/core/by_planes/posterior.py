"""Whether a region is a plane or a curved surface, as a probability.

What a quadratic explains of the residuals of a plane, its bend, has three terms. Noise, the smooth
distortion of the sensor and the bend of the surface itself make it, and each term is Gaussian with
the sum of their variances. Planes of buildings and furniture are not exactly flat, curved objects
are in pieces that bend by a little or by much: how far either bends, as share of its width, is
log-normal, and so is the distortion's variance around the one that is measured. The posterior
compares both hypotheses, the likelihood of each integrated over these (Gauss-Hermite quadrature).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.quadratics import explained

# Medians and logarithmic standard deviations, by maximum likelihood over 96 planes and curved
# regions of 17 annotated frames of 12 sensors: bend over width of planes and of curved surfaces,
# root mean square, and share of the distortion's variance that a plane as wide as it shows.
_PLANE, _CURVED, _SHARE = (0.0023, 0.5), (0.013, 0.5), (0.16, 0.32)
# The distortion of real Kinects over planes of A pixels grows as A^0.39.
_EXPONENT = 0.78
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


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


@njit(cache=True, nogil=True)
def plane_probabilities(
    residuals: Residuals, around: float, alike: float, prior: float
) -> NDArray[np.float64]:
    """Posterior probability of each region to be a plane and no curved surface.

    Parameters
    ----------
    residuals : Residuals
        Of M + 1 regions.
    around : float
        Pixels of a square as wide as the distortion.
    alike : float
        Pixels whose noise is alike.
    prior : float
        Share of planes among regions.

    Returns
    -------
    (M + 1,) float64
        The prior where nothing tells; 0 for region 0.
    """
    result = np.zeros(len(residuals.covered))
    for k in range(1, len(result)):
        size = max(residuals.powers[k, 0], 1.0)
        linear, bend = explained(residuals.powers[k], residuals.right[k])
        # Noise as the region itself shows it: at a grazing angle it is more than the sensor's.
        noise = alike * max((residuals.square[k] - linear - bend) / size, 1.0)
        covered = residuals.covered[k]
        distortion = residuals.ratio[k] * (covered / around) ** _EXPONENT * size / 3
        # Sum of squares, for each of the three terms, of a bend as large as the region is wide.
        width = residuals.area[k] * covered / max(residuals.scale[k], 1e-300) ** 2 * size**2 / 3
        plane = prior * _likelihood(bend, noise, distortion, width, _PLANE)
        curved = (1 - prior) * _likelihood(bend, noise, distortion, width, _CURVED)
        result[k] = plane / (plane + curved) if plane + curved > 0 else 0.0
    return result


@njit(cache=True)
def _likelihood(
    bend: float, noise: float, distortion: float, width: float, surface: tuple[float, float]
) -> float:
    """Density of three squared Gaussian terms that sum to `bend`, but for a common factor."""
    total = 0.0
    for a in range(len(_NODES)):
        shown = distortion * _SHARE[0] * np.exp(_SHARE[1] * _NODES[a])
        for b in range(len(_NODES)):
            own = surface[0] * np.exp(surface[1] * _NODES[b])
            variance = noise + shown + width * own * own
            total += _WEIGHTS[a] * _WEIGHTS[b] * variance**-1.5 * np.exp(-bend / (2 * variance))
    return total
