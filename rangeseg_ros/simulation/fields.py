"""Gaussian random fields: what noise and distortion of simulated sensors are made of."""

from __future__ import annotations

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Floats


def smooth_field(
    shape: tuple[int, ...], sigma: tuple[float, float] | None, random: np.random.Generator
) -> Floats:
    """Gaussian random field (H, W) of unit variance: white noise, smoothed unless `sigma` is None.

    `sigma` are the standard deviations of the Gaussian kernel along a row and a column, pixels.
    """
    if sigma is None:
        return random.standard_normal(shape)
    pad_x, pad_y = (int(np.ceil(4 * s)) for s in sigma)
    white = random.standard_normal((shape[0] + 2 * pad_y, shape[1] + 2 * pad_x))
    kernel_x, kernel_y = (
        cv2.getGaussianKernel(2 * pad + 1, s) for pad, s in zip((pad_x, pad_y), sigma, strict=True)
    )
    gain = np.linalg.norm(kernel_x) * np.linalg.norm(kernel_y)
    field = cv2.sepFilter2D(white, cv2.CV_64F, kernel_x, kernel_y) / gain
    inside: Floats = field[pad_y : pad_y + shape[0], pad_x : pad_x + shape[1]]
    return inside
