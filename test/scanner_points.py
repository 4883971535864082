"""Exact points and rays of scanners, in double precision."""

import numpy as np


def scanned(camera):
    """Rays (H, W, 3) at even angles, as of a scanner that turns."""
    azimuth = (np.arange(camera.width) - camera.cx) / camera.fx
    elevation = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
    rays = np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth)
    return np.stack(np.broadcast_arrays(*rays[:2], rays[2] * np.cos(elevation)), axis=2)
