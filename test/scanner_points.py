"""Exact points and rays of scanners, in double precision."""

import numpy as np


def abw_points(values, calibration):
    """Points (512, 512, 3) of ABW range values, metres in the optical frame; NaN in shadow."""
    return calibration.camera.rays.astype(float) * calibration.depth(values)[..., None]


def scanned(camera):
    """Rays (H, W, 3) at even angles, as of a scanner that turns."""
    azimuth = (np.arange(camera.width) - camera.cx) / camera.fx
    elevation = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
    rays = np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth)
    return np.stack(np.broadcast_arrays(*rays[:2], rays[2] * np.cos(elevation)), axis=2)
