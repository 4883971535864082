"""A sensor without error: renderings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera


@dataclass(frozen=True)
class Ideal:
    """Exact depth in metres (float32), everywhere."""

    @property
    def camera(self) -> Camera:
        """640x480, of a Kinect's field of view."""
        return Camera(640, 480, 585.0, 585.0, 319.5, 239.5)

    def measure(
        self, depth: NDArray[np.float64], camera: Camera, random: np.random.Generator
    ) -> NDArray[np.float32]:
        """See `Sensor.measure`."""
        return np.where(np.isfinite(depth), depth, 0).astype(np.float32)
