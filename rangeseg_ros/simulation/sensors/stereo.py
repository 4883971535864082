"""Active stereo like the RealSense D400 series.

Depth comes from matching windows of two images, so errors are constant in disparity and look
like blobs of the window's size. What is modelled, in pixels of disparity d = f b / z:

* Matching noise. Its standard deviation on a plane is 0.09 to 0.2 pixels in real frames; the
  maker's figure is 0.05 to 0.1 [1]_. Residuals of real planes are alike by 0.97, 0.94, 0.88, 0.7
  and 0.4 at 1, 2, 4, 8 and 16 pixels, which takes blobs of two sizes; and blobs stretch along
  lines of equal disparity, because the error depends on the fraction of a pixel at which a
  texture is matched (subpixel linearity [2]_). Here it is a random field of the position and d.
* A smooth distortion of the calibration, fixed for a sensor: a bowl and waves, at most about
  0.005 1/m.
* Disparity comes in 1/32 pixels, depth in millimetres [3]_.
* Silhouettes are ragged, and fattened, by about the half of a window.
* No depth: left of what is in front of something (seen by one imager only), in a band at the left
  border of the same origin, closer than 126 pixels of disparity, on patches without texture, in
  specks, and at grazing angles.

References
----------
.. [1] A. Grunnet-Jepsen, J. N. Sweetser, J. Woodfill, "Tuning depth cameras for best
   performance", Intel, 2018.
.. [2] A. Grunnet-Jepsen et al., "Subpixel linearity improvement for Intel RealSense depth camera
   D400 series", Intel, 2019.
.. [3] Intel RealSense D400 series product family datasheet.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.sensors.sensor import (
    Sensor,
    inverse_depth,
    millimetres,
    slopes,
    unseen_from_the_right,
)

BASELINE = 0.050
"""Distance of the right imager of a D435 from the left one, metres."""
STEPS = 32
"""Steps of the disparity per pixel."""
LARGEST = 126
"""Disparity searched for, pixels."""
# Matching noise: kernel width in pixels, standard deviation and period in pixels of disparity.
_BLOBS = ((1.5, 0.035, 0.5), (4.0, 0.05, 1.0), (9.0, 0.10, 3.0))
_WHITE = 0.02
# Fixed distortion, 1/m: the bowl from centre to corner, and waves.
_BOWL, _WAVES = 0.003, 0.0008


class RealSense(Sensor):
    """D435 at 848x480, 90 degrees wide."""

    camera = Camera(848, 480, 424.0, 424.0, 423.5, 239.5)

    def measure(
        self, depth: Floats, camera: Camera, random: np.random.Generator
    ) -> NDArray[np.uint16]:
        true = inverse_depth(depth)
        inverse = _fattened(true, random)
        scale = camera.fx * BASELINE
        disparity = scale * (inverse + distortion(camera.shape, self.seed))
        disparity += _matching_noise(scale * inverse, random)
        disparity = np.rint(STEPS * disparity) / STEPS
        # One percent of the surfaces lacks texture, in patches of some ten pixels.
        bare = smooth_field(camera.shape, (12.0, 12.0), random) < -2.33
        specks = smooth_field(camera.shape, (1.0, 1.0), random) > 3.2
        blind = bare | specks | (disparity <= 0.5) | (disparity > LARGEST)
        blind |= unseen_from_the_right(true, camera, BASELINE)
        blind |= np.arange(camera.width) < disparity
        ragged = smooth_field(camera.shape, (2.5, 2.5), random)
        blind |= np.degrees(np.arctan(slopes(true, camera))) + 2 * ragged > 84
        return millimetres(scale / np.maximum(disparity, 0.5), ~blind)


@lru_cache(maxsize=4)
def distortion(shape: tuple[int, int], seed: int) -> Floats:
    """Fixed error of the inverse depth of one sensor, (H, W) 1/m."""
    height, width = shape
    random = np.random.default_rng([seed, 10])
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    bowl = random.choice([-1, 1]) * random.uniform(0.5, 1) * _BOWL * (u**2 + v**2 - 2 / 3)
    waves = _WAVES * smooth_field(shape, (0.07 * width, 0.07 * width), random)
    pattern: Floats = bowl + waves
    pattern.setflags(write=False)
    return pattern


def _matching_noise(disparity: Floats, random: np.random.Generator) -> Floats:
    """Error of the disparity, pixels: alike where position and subpixel phase are alike."""
    noise = _WHITE * random.standard_normal(disparity.shape)
    for width, deviation, period in _BLOBS:
        phase = 2 * np.pi * disparity / period
        for wave in (np.cos(phase), np.sin(phase)):
            noise += deviation * wave * smooth_field(disparity.shape, (width, width), random)
    return noise


def _fattened(inverse: Floats, random: np.random.Generator) -> Floats:
    """Inverse depth with silhouettes displaced by about two pixels, mostly outwards."""
    shape = inverse.shape
    nearer = cv2.dilate(inverse, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)))
    farther = cv2.erode(inverse, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    ragged = smooth_field(shape, (3.0, 3.0), random)
    chosen = np.where(ragged > 0, nearer, np.where(ragged < -1, farther, inverse))
    # A surface changes less than that over two pixels, a silhouette more.
    silhouette: Floats = np.where(np.abs(chosen - inverse) > 0.05, chosen, inverse)
    return silhouette
