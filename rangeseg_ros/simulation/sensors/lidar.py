"""Solid-state lidar of a phone or tablet: few points, made dense and smooth by software.

The sensor measures 24 x 24 points [1]_; the device fuses them with its colour image into a depth
map of 256 x 192 pixels without holes [2]_. Real frames show what that leaves: noise of a few
tenths of a millimetre, which is little more than the rounding, smooth waves of 5 to 8 mm that
are alike over some twenty pixels, and silhouettes blurred over a few pixels.

References
----------
.. [1] "Scaniverse adds high-detail 3D scans", Scaniverse, 2021 (from teardowns of the scanner).
.. [2] Apple, "ARFrame.sceneDepth", ARKit documentation.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.sensors.sensor import Sensor, inverse_depth, millimetres

POINTS = 24
"""Points measured along each side of the image."""
FARTHEST = 8.0
"""Metres."""
# Waves and noise of the range, metres.
_WAVES, _NOISE = 0.008, 0.0006
# Width of the Gaussian that silhouettes are blurred with, pixels.
_BLUR = 1.5


class Lidar(Sensor):
    """Lidar of a tablet, 62 degrees wide; all are alike, nothing is fixed from frame to frame."""

    camera = Camera(256, 192, 212.0, 212.0, 127.5, 95.5)

    def measure(
        self, depth: Floats, camera: Camera, random: np.random.Generator
    ) -> NDArray[np.uint16]:
        # Blurred in inverse depth, in which surfaces stay plane.
        inverse = cv2.GaussianBlur(inverse_depth(depth), (0, 0), _BLUR)
        spacing = 2.0 * camera.width / POINTS
        waves = _WAVES * smooth_field(camera.shape, (spacing, spacing), random)
        noise = _NOISE * random.standard_normal(camera.shape)
        measured = 1 / np.maximum(inverse, 1e-3) + waves + noise
        return millimetres(measured, np.isfinite(depth) & (measured < FARTHEST))
