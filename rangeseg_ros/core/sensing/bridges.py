"""Small holes in the measurements, bridged where the surface around them goes on."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.sensing.blocks import for_pixels
from rangeseg_ros.core.sensing.range_image import RangeImage

# Of the eight pixels around a hole: a straight border of what was measured has three.
_MEASURED = 4
_WINDOW = np.ones((3, 3), np.uint8)


def bridge_holes(image: RangeImage, steps: Singles, slopes: Singles) -> RangeImage:
    """The image with missing pixels as the mean of those around them.

    At least half of these are measured, and they continue each other: their inverse ranges differ
    by no more than a jump and the slope of the surface across the window, which the two sides of a
    shadow do not. `steps` and `slopes`, from pixel to pixel, are those of every block, 1/m.
    """
    valid, inverse = image.valid, image.inverse
    if valid.all():
        return image
    nearest = cv2.dilate(inverse, _WINDOW)
    farthest = cv2.erode(np.where(valid, inverse, np.float32(np.inf)), _WINDOW)
    continued = nearest - farthest <= for_pixels(steps + 2 * slopes, image.shape)
    count, seen = _sum(valid.astype(np.float32)), valid[..., None]
    bridged = ~valid & (count >= _MEASURED) & continued
    values = _sum(np.where(seen, np.dstack([inverse, image.rays]), np.float32(0)))
    means = values / np.maximum(count, 1)[..., None]
    rays = image.rays
    if image.camera is None:  # those of a cloud lie between its points, a camera's are everywhere
        rays = np.where(bridged[..., None], means[..., 1:], rays)
    return replace(image, inverse=np.where(bridged, means[..., 0], inverse), rays=rays)


def _sum(values: Singles) -> Singles:
    """Sum of the window around every pixel."""
    result = cv2.boxFilter(values, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(result, np.float32)
