"""The two scanners of the segmentation comparison of Hoover et al.: range values to points.

Everything is in metres in the optical frame: x right, y down, z forward.

References
----------
A. Hoover et al., "An experimental comparison of range image segmentation algorithms", IEEE TPAMI
18(7), 1996; geometry as in its published conversion program, range-to-coords.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.segcomp.files import SIZE, SegcompError


@dataclass(frozen=True)
class AbwCalibration:
    """Geometry of the ABW structured-light scanner, a pinhole camera.

    The published formulas x = (c - 255) (v / scale + offset) / |f|,
    y = (255 - r) / aspect (v / scale + offset) / |f|, z = (255 - v) / scale describe rays through
    one centre at the depth v / scale + offset; here they are given in the optical frame of that
    centre (x right, y down, z forward, metres; the published unit is taken as the millimetre).
    `offset` is the depth of range value 0, mm; `scale` range values per mm; `focal` in columns.
    """

    offset: float
    scale: float
    focal: float

    _ASPECT = 1.4508

    @property
    def camera(self) -> Camera:
        """The scanner as a camera: 512 x 512, pixels lower than wide."""
        return Camera(SIZE, SIZE, self.focal, self.focal * self._ASPECT, 255.0, 255.0)

    def depth(self, values: ArrayLike) -> NDArray[np.float64]:
        """Depth in metres of range values; NaN for 0, which is shadow."""
        array = np.asarray(values, dtype=float)
        return np.where(array == 0, np.nan, (array / self.scale + self.offset) * 1e-3)


ABW_FIRST = AbwCalibration(785.410786, 0.773545, 1610.981722)
ABW_SECOND = AbwCalibration(771.016866, 0.791686, 1586.072821)
_FIRST_TEST_IMAGES = frozenset((0, 19, 21, 25, 27, 28, 29))


def abw_calibration(number: int, split: str = 'test') -> AbwCalibration:
    """Calibration of an ABW image, by its number in the `test` or `train` set."""
    return ABW_FIRST if split == 'test' and number in _FIRST_TEST_IMAGES else ABW_SECOND


def abw_range_image(values: ArrayLike, calibration: AbwCalibration) -> RangeImage:
    """Range image of (512, 512) ABW range values."""
    _check_size(values, 'ABW')
    return RangeImage.from_depth(calibration.depth(values).astype(np.float32), calibration.camera)


# The published program names no unit. With 4096 steps of 0.20236 the range covers 829 units:
# 8.3 m in centimetres, the ambiguity interval of an 18 MHz modulation, and mirrors 3 and 5.5 cm
# apart; millimetres would put the mirrors 3 mm from each other.
_PERCEPTRON_UNIT = 0.01
_STEP = 0.20236
_STANDOFF = 830.3


def perceptron_points(values: ArrayLike) -> NDArray[np.float64]:
    """Points (512, 512, 3) of range values (512, 512) of the Perceptron laser scanner, metres.

    It has no single centre: its beams leave a rotating mirror and a nodding one. The origin is at
    the second mirror.
    """
    h1, h2 = 3.0, 5.5
    gamma = theta = np.pi / 4
    pixel = np.arange(SIZE)
    alpha = np.radians(51.65 * (255.5 - pixel) / SIZE)[None, :]
    beta = np.radians(36.73 * (255.5 - pixel) / SIZE)[:, None]
    dz = -h1 * (1 - np.cos(alpha)) / np.tan(gamma)
    dy = dz * np.tan(theta + beta / 2)
    dx = (h2 + dy) * np.tan(alpha)
    # Of the beam inside the scanner.
    lead = (dz - h2) + np.hypot(dx, h2 + dy)
    length = (np.asarray(values, dtype=float) + _STANDOFF) * _STEP - lead
    # Published: x left, y up, z forward.
    x = -dx - length * np.sin(alpha)
    y = -dy - length * np.cos(alpha) * np.sin(beta)
    z = dz + length * np.cos(alpha) * np.cos(beta)
    return np.stack([x, y, z], axis=-1) * _PERCEPTRON_UNIT


def perceptron_range_image(values: ArrayLike) -> RangeImage:
    """Range image of (512, 512) Perceptron range values."""
    _check_size(values, 'Perceptron')
    return RangeImage.from_points(perceptron_points(values))


def _check_size(values: ArrayLike, sensor: str) -> None:
    """Raise SegcompError for an image of another size."""
    shape = np.shape(values)
    if shape != (SIZE, SIZE):
        raise SegcompError(f'{sensor} range images are {SIZE}x{SIZE}, not {shape}')
