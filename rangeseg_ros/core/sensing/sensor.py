"""How a sensor errs: the standard deviation of the inverse range, part by part."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import nnls

from rangeseg_ros.core.config import Config

_BINS = 8
_PER_BIN = 20
# Blocks enough to tell the noise by.
_MOST = 4000
# Most blocks lie on planes, but edges and curvature only ever add to the residuals.
_QUANTILE = 0.4


class SensorModel(NamedTuple):
    """Error of the inverse range of a pixel, 1/m.

    A structured-light sensor's error is about constant in disparity, hence in inverse range; a
    laser's is constant in range. Each part is the root of the squares of both kinds.

    Attributes
    ----------
    noise : float
        Random error of the inverse range, standard deviation, 1/m.
    range_noise : float
        Random error of the range, metres.
    white : float
        Share of the random variance that is new in every pixel, like quantisation.
    correlation : float
        Width of the Gaussian kernel the rest looks smoothed with, pixels; 0 for white noise.
    distortion : float
        Smooth systematic error of the inverse range, standard deviation, 1/m.
    range_distortion : float
        Smooth systematic error of the range, metres.
    distortion_length : float
        Width of the Gaussian kernel the distortion looks smoothed with, pixels.
    pixel_noise : float
        Random error of a pixel's direction, pixels: what surfaces seen at a grazing angle are
        noisier by.
    """

    noise: float
    range_noise: float
    white: float
    correlation: float
    distortion: float
    range_distortion: float
    distortion_length: float
    pixel_noise: float = 0.0

    @classmethod
    def from_config(cls, config: Config) -> SensorModel:
        """The sensor that `config` describes."""
        return cls(
            config.noise,
            config.range_noise,
            config.white_noise,
            config.noise_correlation,
            config.distortion,
            config.range_distortion,
            config.distortion_length,
            config.pixel_noise,
        )

    @property
    def patch(self) -> float:
        """Pixels that count as one measurement of the labelling, which compares neighbours.

        The variance of the mean of 2 x 2 pixels over that of white noise: 1 to 4.
        """
        if self.correlation == 0:
            return 1.0
        alike = (1 - self.white) * np.exp(-np.array([1, 2]) / (4 * self.correlation**2))
        return float(1 + 2 * alike[0] + alike[1])

    def measured(self, inverse: NDArray[np.float64], residual: NDArray[np.float64]) -> SensorModel:
        """The model with the random error an image shows, never less than its own.

        Parameters
        ----------
        inverse : (N,) float64
            Mean inverse range of small blocks, 1/m.
        residual : (N,) float64
            Mean square residual of a plane fitted to each block, unbiased, (1/m)^2.
        """
        sparse = slice(None, None, max(len(inverse) // _MOST, 1))
        inverse, residual = inverse[sparse], residual[sparse]
        bins = min(_BINS, len(inverse) // _PER_BIN)
        if bins == 0:
            return self
        parts = np.array_split(np.argsort(inverse, kind='stable'), bins)
        at = np.array([inverse[part[len(part) // 2]] for part in parts])
        ranked = [np.sort(residual[part]) for part in parts]
        shown = np.array([part[int(_QUANTILE * len(part))] for part in ranked])
        variance = np.maximum(shown, random_variance(self, at**2))
        # Relative errors count the same at every range.
        terms = np.stack([np.ones(bins), at**4], axis=1) / variance[:, None]
        (constant, quartic), _ = nnls(terms, np.ones(bins))
        return self._replace(
            noise=max(float(np.sqrt(constant)), self.noise),
            range_noise=max(float(np.sqrt(quartic)), self.range_noise),
        )


# No sensor is without error: an exact (simulated) image has that of its float32 numbers.
FLOOR = 1e-12


@njit(cache=True, inline='always')
def random_variance(sensor: SensorModel, squared: NDArray[np.float64] | float) -> Any:
    """Variance of the random error at the square of an inverse range, (1/m)^2.

    An error ds of the range is one of ds / s^2 of its inverse.
    """
    return FLOOR + sensor.noise**2 + (sensor.range_noise * squared) ** 2


@njit(cache=True, inline='always')
def systematic_variance(sensor: SensorModel, squared: NDArray[np.float64] | float) -> Any:
    """Variance of the systematic error at the square of an inverse range, (1/m)^2."""
    return sensor.distortion**2 + (sensor.range_distortion * squared) ** 2
