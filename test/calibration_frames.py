"""Frames of planes that a known field distorts."""

import numpy as np

from rangeseg_ros import Camera, RangeImage
from rangeseg_ros.core.calibration.calibrate import without_plane
from rangeseg_ros.simulation.fields import smooth_field

CAMERA = Camera(80, 60, 73.0, 73.0, 39.5, 29.5)
NOISE = 0.0013


def true_map(scale=0.002):
    """Waves and a bowl, without their plane."""
    v, u = np.mgrid[-1:1:60j, -1:1:80j]
    field = scale * (1.5 * u * u + np.sin(4 * u + 1) * np.cos(3 * v))
    return without_plane(field, np.ones(CAMERA.shape, bool))


def frames(count, error, seed=0, noise=NOISE, depths=(0.8, 3.0)):
    """Two slanted planes side by side in each frame, at depths that change: image and labels."""
    random = np.random.default_rng(seed)
    rays = CAMERA.rays.astype(float)
    for _ in range(count):
        edge = random.integers(25, 55)
        labels = np.ones(CAMERA.shape, np.uint16)
        labels[:, edge:] = 2
        inverse = np.zeros(CAMERA.shape)
        for label in (1, 2):
            depth = random.uniform(*depths)
            theta = np.array([*random.uniform(-0.3, 0.3, 2), 1]) / depth
            inverse[labels == label] = (rays @ theta)[labels == label]
        wrong = error(inverse) if callable(error) else error
        measured = inverse + wrong + noise * smooth_field(CAMERA.shape, (1.0, 1.0), random)
        depth = (1 / np.maximum(measured, 0.05)).astype(np.float32)
        yield labels, RangeImage.from_depth(depth, CAMERA)


def rms(image):
    return float(np.sqrt((image**2).mean()))
