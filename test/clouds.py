"""Clouds of sensors that are no pinhole cameras."""

import numpy as np

from rangeseg_ros.core.sensing.range_image import RangeImage


def cloud_of(points):
    """Range image of points (H, W, 3) whatever took them: unit rays, where there are points."""
    points = np.where(np.isfinite(points).all(axis=2, keepdims=True), points, 0).astype(float)
    distance = np.linalg.norm(points, axis=2)
    inverse = np.divide(1, distance, out=np.zeros_like(distance), where=distance > 0)
    rays = (points * inverse[..., None]).astype(np.float32)
    rays.flags.writeable = False
    return RangeImage(rays, inverse.astype(np.float32))


def scanned(camera):
    """Rays (H, W, 3) at even angles, as of a scanner that turns."""
    azimuth = (np.arange(camera.width) - camera.cx) / camera.fx
    elevation = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
    rays = np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth)
    return np.stack(np.broadcast_arrays(*rays[:2], rays[2] * np.cos(elevation)), axis=2)
