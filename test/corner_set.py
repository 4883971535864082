"""A corner of two walls as the sets that `rangeseg evaluate` reads; its regions are exact."""

import numpy as np
from dataset_files import raster

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.segcomp import abw_calibration

CAMERA = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
# Two walls that meet in the vertical line x = 0, z = 2.
LEFT = np.array([np.sqrt(0.5), 0.0, -np.sqrt(0.5), 2 * np.sqrt(0.5)])
RIGHT = np.array([-np.sqrt(0.5), 0.0, -np.sqrt(0.5), 2 * np.sqrt(0.5)])


def corner(rays):
    """Distance along rays from the origin to a corner of two walls, and labels 1 and 2."""
    reach = np.stack([-plane[3] / (rays @ plane[:3]) for plane in (LEFT, RIGHT)])
    reach[reach <= 0] = np.inf
    return reach.min(axis=0), (reach.argmin(axis=0) + 1).astype(np.uint16)


def depth_and_truth():
    depth, truth = corner(CAMERA.rays.astype(float))
    depth = np.rint(1000 * depth).astype(np.uint16)
    depth[:6], truth[:6] = 0, 0
    return depth, truth


def segcomp_set(folder):
    """One ABW test image of the corner, 1.1 times nearer, with its truth and its angle."""
    folder.mkdir()
    calibration = abw_calibration(1)
    rays = calibration.camera.rays.astype(float)
    depth, truth = corner(rays)
    values = (500 * depth - calibration.offset) * calibration.scale
    values = np.rint(values).clip(1, 255).astype(np.uint8)
    (folder / 'abw.test.1.range').write_bytes(raster(values))
    (folder / 'abw.test.1.gt-seg').write_bytes(raster((truth + 9).astype(np.uint8)))
    (folder / 'abw.test.1.gt-ang').write_text('1\n10 11 90.0\n')
    return folder
