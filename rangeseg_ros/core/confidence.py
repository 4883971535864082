"""How surely each pixel belongs to its plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.cells import variances
from rangeseg_ros.core.planes import Plane
from rangeseg_ros.core.range_image import RangeImage
from rangeseg_ros.core.sensor import SensorModel

# Other labels this many pixels to each side are rivals.
_REACH = 8
# Squared deviations at which no plane is as likely as the pixel's own.
_NO_PLANE = 9.0


def confidence(
    labels: NDArray[np.uint16],
    image: RangeImage,
    planes: Sequence[Plane],
    sensor: SensorModel,
) -> NDArray[np.uint8]:
    """Probability of each pixel's label given its depth, times 255.

    Against the labels that the pixel might have had as likely before its depth was known: those
    8 pixels to the left, right, above and below, and none, which explains any depth as well as a
    plane explains one three standard deviations off. The standard deviation is that of the
    random and systematic errors together. So 252 inside a region on its plane, 127 where a crease
    leaves the choice between two planes open or the depth is three deviations off, and near 0
    for depths the plane does not explain.

    Parameters
    ----------
    labels : (H, W) uint16
        0 = no plane.
    image : RangeImage
        (H, W).
    planes : sequence of Plane
        Of the labels.
    sensor : SensorModel
        Its errors.

    Returns
    -------
    (H, W) uint8
        0 where there is no plane or no depth.
    """
    theta = np.zeros((int(labels.max(initial=0)) + 1, 3))
    for plane in planes:
        theta[plane.label] = -plane.normal / plane.distance
    return _posterior(labels, image.inverse, image.rays, theta, variances(sensor))


@njit(cache=True)
def _posterior(
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    theta: NDArray[np.float64],
    variances: NDArray[np.float64],
) -> NDArray[np.uint8]:
    height, width = labels.shape
    result = np.zeros((height, width), np.uint8)
    rivals = np.zeros(4, np.intp)
    for i in range(height):
        for j in range(width):
            label = int(labels[i, j])
            y = float(inverse[i, j])
            if label == 0 or y == 0:
                continue
            variance = variances[0] + variances[2] + (variances[1] + variances[3]) * y**4
            own = _square(rays[i, j], y, theta[label]) / variance
            others = np.exp((own - _NO_PLANE) / 2) if own < 500 else np.inf
            rivals[0] = labels[max(i - _REACH, 0), j]
            rivals[1] = labels[min(i + _REACH, height - 1), j]
            rivals[2] = labels[i, max(j - _REACH, 0)]
            rivals[3] = labels[i, min(j + _REACH, width - 1)]
            for k in range(4):
                rival = rivals[k]
                known = rival == 0 or rival == label
                for m in range(k):
                    known |= rivals[m] == rival
                if not known and own < 500:
                    square = _square(rays[i, j], y, theta[rival]) / variance
                    others += np.exp((own - square) / 2)
            result[i, j] = np.uint8(255 / (1 + others))
    return result


@njit(cache=True)
def _square(ray: NDArray[np.float32], y: float, plane: NDArray[np.float64]) -> float:
    residual = y - plane[0] * ray[0] - plane[1] * ray[1] - plane[2] * ray[2]
    return residual * residual
