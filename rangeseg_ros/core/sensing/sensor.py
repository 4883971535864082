"""How a sensor errs: the standard deviation of the inverse range, part by part."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.config import VGA, Config

# Sum of the correlations exp(-d^2 / (4 w^2)) along a line, in units of the kernel's width w.
_LINE = 2 * float(np.sqrt(np.pi))


class SensorModel(NamedTuple):
    """Standard deviations of the error of a pixel, of the inverse range (1/m) and the range (m).

    A structured-light sensor's error is about constant in disparity, hence in inverse range; a
    laser's is constant in range. Each part is the root of the squares of both kinds.
    """

    noise: float  # random
    range_noise: float
    white: float  # share of the random variance that is new in every pixel, like quantisation
    correlation: float  # width of the Gaussian the rest looks smoothed with, pixels; 0 for white
    distortion: float  # systematic, smooth
    range_distortion: float
    distortion_length: float  # width of the Gaussian it is smoothed with at most, pixels
    # Random error of a pixel's direction, pixels: what surfaces at grazing angles are noisier by.
    direction_noise: float = 0.0
    unbent: float = 1.0  # share of the distortion's variance in small blocks, which bend least
    quantum: float = 0.0  # step that the inverse range is rounded to, 0 for none
    range_quantum: float = 0.0
    # Standard errors of what was measured, as shares of it; 0 where they are not known.
    noise_error: float = 0.0
    distortion_error: float = 0.0

    @classmethod
    def from_config(cls, config: Config, shape: tuple[int, int] = (480, 640)) -> SensorModel:
        """The sensor that `config` describes, of images (H, W)."""
        return cls(
            config.noise,
            config.range_noise,
            config.white_noise,
            config.noise_correlation,
            config.distortion,
            config.range_distortion,
            length_of_distortion(config.distortion_length, shape),
            config.pixel_noise,
        )

    def rescaled(self, step: float) -> SensorModel:
        """The model of images with one pixel for each `step` pixels along rows and columns."""
        return self._replace(
            correlation=self.correlation / step,
            distortion_length=self.distortion_length / step,
            direction_noise=self.direction_noise / step,
        )

    def binned(self, side: int) -> SensorModel:
        """The model of the means of squares of so many pixels along the side."""
        line = np.arange(side)
        correlation = np.zeros((side, side))
        if self.correlation > 0:
            correlation = np.exp(-((line[:, None] - line) ** 2) / (4 * self.correlation**2))
        white = self.white / side**2
        left = white + (1 - self.white) * max(float(correlation.mean()) ** 2, 1 / side**2)
        return self.rescaled(side)._with_variance(left)._replace(white=white / left)

    def of_pixels(self, side: int, excess: float) -> SensorModel:
        """The model of pixels, of the means of whose squares this one is.

        Their random variance is `excess` times that of the means, and what it is more is new in
        every pixel.
        """
        pixels = self.rescaled(1 / side)._with_variance(excess)
        return pixels._replace(white=1 - (1 - self.white) / excess)

    def _with_variance(self, share: float) -> SensorModel:
        """The model whose random variance is this share of it."""
        return self._replace(
            noise=self.noise * share**0.5,
            range_noise=self.range_noise * share**0.5,
            direction_noise=self.direction_noise * share**0.5,
        )

    def __str__(self) -> str:
        """Errors in one line, such as: noise 0.0034 1/m ± 3%, correlated over 9 px, ..."""
        errors = (
            ('noise', self.noise, '1/m', self.noise_error),
            ('range noise', self.range_noise, 'm', self.noise_error),
            ('distortion', self.distortion, '1/m', self.distortion_error),
            ('range distortion', self.range_distortion, 'm', self.distortion_error),
            ('steps of', self.quantum, '1/m', 0),
            ('steps of', self.range_quantum, 'm', 0),
        )
        said = [
            f'{name} {value:.2g} {unit}' + (f' ± {off:.0%}' if off > 0 else '')
            for name, value, unit, off in errors
            if value > 0
        ]
        # Over as many pixels as the correlation along a line sums to.
        kinds = sum(value > 0 for _, value, *_ in errors[:2])
        if kinds and self.white < 0.5 and _LINE * self.correlation > 1:
            said.insert(kinds, f'correlated over {_LINE * self.correlation:.0f} px')
        return ', '.join(said)

    @property
    def pixel_inflation(self) -> float:
        """Variance of the mean of 2 x 2 pixels over that of white noise, 1 to 4.

        So many pixels count as one measurement of the labelling, which compares neighbours.
        """
        if self.correlation == 0:
            return 1.0
        correlation = (1 - self.white) * np.exp(-np.array([1, 2]) / (4 * self.correlation**2))
        return float(1 + 2 * correlation[0] + correlation[1])

    @property
    def region_inflation(self) -> float:
        """Pixels of a large region that count as one measurement: the sum of the correlations."""
        return self.white + (1 - self.white) * max(4 * np.pi * self.correlation**2, 1.0)

    @property
    def distortion_pixels(self) -> float:
        """Pixels of a square as wide as the distortion: smaller regions meet one value of it."""
        return self.distortion_length**2

    @property
    def block_inflation(self) -> float:
        """By how much the noise of neighbouring blocks of 4 pixels exceeds that of white noise."""
        if self.correlation == 0:
            return 1.0
        return self.white + (1 - self.white) * correlated_residuals(self.correlation)[3]


def length_of_distortion(stated: float, shape: tuple[int, int]) -> float:
    """Width of the distortion in images (H, W), pixels: as stated; 0 is 3 degrees of a Kinect."""
    return stated or 35 * float(np.sqrt(shape[0] * shape[1] / VGA))


@cache
def correlated_residuals(width: float) -> tuple[float, float, float, float]:
    """What planes through blocks of 4, 8 and 16 pixels leave of correlated noise of unit variance.

    Mean square for each degree of freedom; last, what one plane through four blocks of 4 pixels
    leaves beyond the planes of the four. The noise looks smoothed with a Gaussian of this width:
    two pixels d apart correlate by exp(-d^2 / (4 width^2)).
    """
    left = []
    for side in (4, 8, 16):
        line = np.arange(side)
        field = np.exp(-((line[:, None] - line) ** 2) / (4 * width**2))
        row, column = np.indices((side, side)).reshape(2, -1)
        basis, _ = np.linalg.qr(np.stack([np.ones(side**2), row, column], axis=1))
        covariance = np.kron(field, field)
        left.append(np.trace(covariance) - np.trace(basis.T @ covariance @ basis))
    four, eight, sixteen = (float(square) for square in left)
    return four / 13, eight / 61, sixteen / 253, (eight - 4 * four) / 9


# Share of a distortion's variance that a plane fitted to a square of its width leaves: the
# maximum-likelihood estimate from planes of 12 sensors.
_SHARE = 0.15


@njit(cache=True, inline='always')
def distortion_share(pixels: float, smooth: float) -> float:
    """Mean square that a plane leaves of so many pixels, in variances of the distortion.

    `smooth` are the `distortion_pixels` of the sensor. On 107 planes of real Kinects the deviation
    grows as A^0.39; of 3/8, two square roots are quicker than a power.
    """
    ratio = np.sqrt(pixels / smooth)
    return float(_SHARE * ratio * np.sqrt(ratio))


FLOOR = 1e-12  # (1/m)^2, rounding of float32: the least variance, of exact (simulated) images


@register_jitable(inline='always')
def random_variance(sensor: SensorModel, squared: Floats | float) -> Any:
    """Variance of the random error at the square of an inverse range, (1/m)^2.

    An error ds of the range is one of ds / s^2 of its inverse.
    """
    return FLOOR + sensor.noise**2 + (sensor.range_noise * squared) ** 2


@register_jitable(inline='always')
def tilt_variance(sensor: SensorModel, slope: Any) -> Any:
    """Variance that errors of direction add where the square of the slope is this, (1/m)^2."""
    return sensor.direction_noise**2 * slope


@register_jitable(inline='always')
def systematic_variance(sensor: SensorModel, squared: Floats | float) -> Any:
    """Variance of the systematic error at the square of an inverse range, (1/m)^2."""
    return sensor.distortion**2 + (sensor.range_distortion * squared) ** 2
