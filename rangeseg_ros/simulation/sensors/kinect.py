"""Kinect-type structured light.

The model and its figures were measured on real frames of five sensors (residuals of 107
hand-annotated planes). The unit is one disparity quantum, 1/8 pixel, in which almost every
effect is constant: 1/z = 0.00290 * disparity, z in metres, so that one quantum is 2.9 mm at
1 m and 26 mm at 3 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Mask, Singles
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.sensors.sensor import (
    Sensor,
    inverse_depth,
    millimetres,
    resize,
    slopes,
    unseen_from_the_right,
)

QUANTUM = 0.00290
"""Inverse depth of one disparity quantum, 1/m."""
BASELINE = 0.075
"""Distance of the projector to the right of the camera, metres."""
SHADOW_SHARE = 0.75
"""Part of a shadow's geometric width that real sensors leave blank (median)."""
NOISES = ('measured', 'correlated', 'independent', 'none')


@dataclass(frozen=True)
class Kinect(Sensor):
    """Kinect v1, with a choice of its noise.

    measured: fixed distortion, vertical bands, correlated noise, blind zones. independent: sigma =
    0.0012 + 0.0019 (z - 0.4)^2 m (Nguyen, Izadi and Lovell 2012); correlated: the same, correlated
    over 1.5 pixels as by block matching. These three quantise disparity to 1/8 pixel and depth to
    millimetres. none: exact metres. All have the shadows of the projector.
    """

    noise: str = 'measured'
    camera = Camera(640, 480, 585.0, 585.0, 319.5, 239.5)

    def __post_init__(self) -> None:
        if self.noise not in NOISES:
            raise ValueError(f'noise must be one of {", ".join(NOISES)}, not {self.noise!r}')

    def measure(
        self, depth: Floats, camera: Camera, random: np.random.Generator
    ) -> NDArray[np.uint16] | Singles:
        inverse = inverse_depth(depth)
        share = SHADOW_SHARE if self.noise == 'measured' else 1.0
        blind = ~np.isfinite(depth) | unseen_from_the_right(inverse, camera, share * BASELINE)
        depth = np.where(blind, 1.0, depth)
        if self.noise == 'none':
            return np.where(blind, 0, depth).astype(np.float32)
        if self.noise == 'measured':
            disparity, zones = self._measured(depth, slopes(inverse, camera), random)
            blind |= zones
        else:
            width = (1.5, 1.5) if self.noise == 'correlated' else None
            error = 0.0012 + 0.0019 * (depth - 0.4) ** 2
            error *= smooth_field(depth.shape, width, random)
            disparity = 1 / (QUANTUM * np.maximum(depth + error, 0.1))
        # One quantum of disparity stands for infinity: nothing is measured beyond 65 m.
        return millimetres(1 / (QUANTUM * np.maximum(np.rint(disparity), 1)), ~blind)

    def _measured(
        self, depth: Floats, slope: Floats, random: np.random.Generator
    ) -> tuple[Floats, Mask]:
        """Disparity as real sensors see `depth`, quanta before rounding, and what they do not see.

        The sum of the true disparity, `sensor_pattern`, a smooth distortion new in every frame
        with a quarter of the pattern's variance, and pixel noise of 0.37 quanta correlated over 2
        pixels that grows with the tangent `slope` of the angle of incidence. These reproduce the
        0.45 quanta of residual noise (quantisation included) and its autocorrelation (0.5 at
        1.4-1.9 pixels) of real frames. Nothing is seen nearer than 0.8 m, in the last eight
        columns, and, with ragged borders, on surfaces seen at more than about 80 degrees.
        """
        ragged = 2 * smooth_field(depth.shape, (2.5, 2.5), random)
        blind = np.degrees(np.arctan(slope)) + ragged > 80
        blind |= depth < 0.8
        blind[:, -8:] = True
        fresh = 0.25 * smooth_field(depth.shape, _distortion_scale(depth.shape[1]), random)
        noise = 0.37 * (1 + 0.25 * np.maximum(slope - 0.7, 0))
        noise = noise * smooth_field(depth.shape, (2.0, 2.0), random)
        pattern = sensor_pattern(depth.shape, self.seed)
        return 1 / (QUANTUM * depth) + pattern + fresh + noise, blind


def kinect_camera(width: int = 640, height: int = 480) -> Camera:
    """Intrinsics of a Kinect whose image of the same field of view has that many columns."""
    return resize(Kinect.camera, width, height)


@lru_cache(maxsize=4)
def sensor_pattern(shape: tuple[int, ...], sensor_seed: int) -> Floats:
    """Fixed error of one sensor, (H, W) quanta of disparity.

    A smooth distortion (standard deviation 0.5, correlated over 26 columns and 45 rows of a
    640x480 image, twice as strong at the left and right borders) and vertical bands: steps of
    0.4 to 1.0 every 75 to 105 columns, or one of 0.75 at the middle column, ramped back between.
    """
    width = shape[1]
    random = np.random.default_rng([sensor_seed, 5])
    scale = width / 640
    column = np.arange(width)
    border = np.minimum(column, width - 1 - column) / scale
    # Twice as strong within 60 columns of the border, without a step where that begins.
    strength = 0.5 * (1 + np.clip((75 - border) / 30, 0, 1))
    distortion = strength * smooth_field(shape, _distortion_scale(width), random)
    if random.random() < 0.5:
        step, period, first = 0.75, float(width), width / 2
    else:
        step, period = random.uniform(0.4, 1.0), random.uniform(75, 105) * scale
        first = random.uniform(0, period)
    step *= random.choice([-1, 1])
    bands = step * (((column - first) / period) % 1 - 0.5)
    pattern: Floats = distortion + bands
    pattern.setflags(write=False)
    return pattern


def _distortion_scale(width: int) -> tuple[float, float]:
    """Kernel widths of the smooth distortion over columns and rows, pixels."""
    return 26 * width / 640, 45 * width / 640
