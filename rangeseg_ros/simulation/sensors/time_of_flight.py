"""Continuous-wave time-of-flight camera like those of phones.

A pixel measures the phase of modulated light, which is the range along its ray. What is modelled:

* Flying pixels: light of all surfaces in a pixel's footprint adds up, so that the range at a
  silhouette lies between both, weighted by the light that comes back (mixed pixels, [1]_).
* Stray light, within the lens and between walls, adds light of the whole scene that has travelled
  further: a smooth offset of the range that bows ceilings, largest where little light comes back
  ([1]_, [2]_).
* Noise of the range as one over the square root of that light (shot noise, [3]_), smoothed by the
  camera: 8 mm at 2 m, alike by half at two pixels, and streaks along rows.
* A fixed offset of each pixel's range, of millimetres, and wiggling: a periodic error of the
  phase, a few millimetres once calibrated ([4]_).
* Millimetres; no depth where too little light comes back, at ragged borders.

References
----------
.. [1] A. A. Dorrington et al., "Separating true range measurements from multi-path and scattering
   interference in commercial range cameras", Proc. SPIE 7864, 2011.
.. [2] J. Mure-Dubois, H. Huegli, "Real-time scattering compensation for time-of-flight camera",
   ICVS 2007.
.. [3] A. Belhedi et al., "Noise modelling in time-of-flight sensors with application to depth
   noise removal and uncertainty estimation in three-dimensional measurement", IET Computer
   Vision 9(6), 2015.
.. [4] M. Lindner et al., "Time-of-flight sensor calibration for accurate range sensing", Computer
   Vision and Image Understanding 114(12), 2010.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.sensors.sensor import Sensor, inverse_depth, millimetres, slopes

# Noise of the range at 2 m head-on, metres, and the filter's widths over columns and rows, pixels.
_NOISE = ((0.006, 0.8, 0.8), (0.004, 3.0, 3.0), (0.003, 8.0, 0.7))
# Stray light as a share of the mean light, over what part of the width, and its detour, metres.
_STRAY, _SPREAD, _DETOUR = 0.015, 0.15, 0.8
# Fixed offset of the pixels; wiggling and its period (a quarter of 7.5 m at 20 MHz), metres.
_OFFSET, _WIGGLING, _PERIOD = 0.007, 0.003, 1.875
_FOOTPRINT = 0.7
"""Width of the Gaussian that a pixel gathers light from, pixels."""


class TimeOfFlight(Sensor):
    """ToF camera of a phone, 68 degrees wide."""

    camera = Camera(240, 180, 179.0, 179.0, 119.5, 89.5)

    def measure(
        self, depth: Floats, camera: Camera, random: np.random.Generator
    ) -> NDArray[np.uint16]:
        ray = np.linalg.norm(camera.rays.astype(np.float64), axis=-1)
        inverse = inverse_depth(depth)
        distance = ray / np.maximum(inverse, 0.01)
        # Lambert's law, the inverse square and how bright the surface is: about 1 at 1 m head-on.
        light = 1 / (distance**2 * np.hypot(1, slopes(inverse, camera)))
        light *= np.exp(0.5 * smooth_field(camera.shape, (12.0, 12.0), random))
        light[~np.isfinite(depth)] = 1e-6
        weighted = _blurred(light * distance, _FOOTPRINT)
        light = _blurred(light, _FOOTPRINT)
        spread = _SPREAD * camera.width
        stray = _STRAY * _blurred(light, spread)
        weighted += _STRAY * _blurred(weighted, spread) + _DETOUR * stray
        measured = weighted / (light + stray)
        # What does not change from frame to frame.
        fixed = np.random.default_rng([self.seed, 11])
        pattern = _OFFSET * smooth_field(camera.shape, 2 * (0.12 * camera.width,), fixed)
        phase = 2 * np.pi * measured / _PERIOD + fixed.uniform(0, 2 * np.pi)
        measured += pattern + _WIGGLING * np.sin(phase)
        # Metres at 2 m head-on.
        noise = np.zeros(camera.shape)
        for deviation, columns, rows in _NOISE:
            noise += deviation * smooth_field(camera.shape, (columns, rows), random)
        measured += noise / np.sqrt(4 * light)
        dim = light < 0.015 * np.exp(0.3 * smooth_field(camera.shape, (2.0, 2.0), random))
        return millimetres(measured / ray, ~dim & np.isfinite(depth) & (measured > 0.1))


def _blurred(image: Floats, sigma: float) -> Floats:
    blurred = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.float64)
