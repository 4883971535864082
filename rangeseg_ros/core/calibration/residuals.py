"""The random part of a sensor's errors, from what planes leave of corrected images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rangeseg_ros.core.calibration.sightings import plane_pixels
from rangeseg_ros.core.sensing.range_image import RangeImage

# Distances of pixels that are compared: dense where noise, sparse where distortion correlates.
LAGS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
# Pixels of a plane whose residuals still hold correlations over the largest of them.
_FEWEST = LAGS[-1] ** 2
# Widths of the Gaussian kernels that are tried, pixels: noise, and distortion.
_NOISE_WIDTHS = np.geomspace(0.5, 16, 26)
_DISTORTION_WIDTHS = np.geomspace(8, 256, 26)


class Randomness(NamedTuple):
    """Parameters of the sensor model, by their names in Config: 1/m, pixels, and a share."""

    noise: float
    white_noise: float
    noise_correlation: float
    distortion: float
    distortion_length: float


def products(labels: NDArray[np.uint16], image: RangeImage) -> NDArray[np.float64]:
    """Sums of products of the residuals of one frame at `LAGS`, and their numbers.

    (2, len(LAGS)): along rows and columns together, pairs on one plane only.
    """
    residual = np.zeros(labels.shape)
    used = np.zeros(labels.shape, np.bool_)
    for plane in plane_pixels(labels, image, _FEWEST):
        residual[plane.mask] = plane.residual
        used |= plane.mask
    return _along_rows(residual, used, labels) + _along_rows(residual.T, used.T, labels.T)


def _along_rows(
    residual: NDArray[np.float64], used: NDArray[np.bool_], labels: NDArray[np.uint16]
) -> NDArray[np.float64]:
    sums = np.zeros((2, len(LAGS)))
    for place, lag in enumerate(LAGS):
        left, right = np.s_[:, : max(labels.shape[1] - lag, 0)], np.s_[:, lag:]
        both = used[left] & used[right] & (labels[left] == labels[right])
        sums[0, place] = (residual[left] * residual[right])[both].sum()
        sums[1, place] = np.count_nonzero(both)
    return sums


def randomness(sums: NDArray[np.float64]) -> Randomness | None:
    """Sensor model of the covariances of residuals at `LAGS`.

    White noise, noise correlated as exp(-l^2 / 4 s^2) and distortion as exp(-l^2 / 4 L^2), all of
    positive variance, for every pair of widths s < L / 2; the pair that fits best.

    Parameters
    ----------
    sums : (2, len(LAGS)) float64
        Of `products`, added up over frames.

    Returns
    -------
    Randomness or None
        None where there are no planes large enough.
    """
    if (sums[1] == 0).any():
        return None
    covariance = sums[0] / sums[1]
    lags = np.array(LAGS, np.float64)
    best, found = np.inf, None
    for width in _NOISE_WIDTHS:
        for length in _DISTORTION_WIDTHS[2 * width < _DISTORTION_WIDTHS]:
            alike = [np.exp(-((lags / scale) ** 2) / 4) for scale in (width, length)]
            terms = np.stack([lags == 0, *alike], axis=1)
            variance, misfit = nnls(terms, covariance)
            if misfit < best:
                best, found = misfit, (width, length, variance)
    assert found is not None
    width, length, (white, correlated, smooth) = found
    noise = max(white + correlated, 1e-18)
    return Randomness(
        float(np.sqrt(noise)),
        float(white / noise),
        float(width),
        float(np.sqrt(smooth)),
        float(length),
    )
