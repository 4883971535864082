"""Planes without a segmentation: of labels that a test knows, and of stated values."""

import numpy as np

from rangeseg_ros import Config, Plane, RangeImage
from rangeseg_ros.core.description.planes import describe_regions
from rangeseg_ros.core.description.shapes import Shape
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.region_sums import sum_regions
from rangeseg_ros.core.mapping.map_planes import MapOutline
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.sensor import SensorModel

SQUARE = ((-1, -1, 2), (-1, 1, 2), (1, 1, 2), (1, -1, 2))


def fits_of(labels, image, sensor):
    return Fits.of(sum_regions(labels, image, Blocks.of(image), sensor), sensor, not image.camera)


def fit_planes(labels, image, sensor):
    """Plane of every region, fitted and described as those of a segmentation."""
    fits = fits_of(labels, image, sensor)
    return describe_regions(labels, image, fits, fits.roots(), sensor)


def painted(camera, *regions):
    """Labels and planes of (where, normal, distance), painted one over the other."""
    labels, inverse = np.zeros(camera.shape, np.uint16), np.zeros(camera.shape, np.float32)
    for label, (where, normal, distance) in enumerate(regions, 1):
        labels[where] = label
        # Nothing is seen of the part behind the camera.
        facing = -camera.rays[where] @ (normal / np.linalg.norm(normal)) / distance
        inverse[where] = np.maximum(facing, 0)
    image = RangeImage(camera.rays, inverse, camera)
    return labels, fit_planes(labels, image, SensorModel.from_config(Config()))


def stated_plane(label, hull=SQUARE, holes=()):
    """A region of the plane z = 2 m."""
    centre, frame = np.array([0.0, 0.25, 2.0]), np.diag([1.0, -1.0, -1.0])
    names = {'label': label, 'id': label + 100, 'surface': label}
    sure = {'count': 1000 * label, 'rms': 0.003, 'confidence': 0.9, 'probability': 0.75}
    return Plane(
        **names,
        **sure,
        role=('other', 'floor', 'wall')[label % 3],
        normal=np.array([0.0, 0.0, -1.0]),
        distance=2.0,
        covariance=np.arange(16.0).reshape(4, 4),
        centroid=np.array([0.25 * label, 0.5, 2.0]),
        shape=Shape(4.0, np.array([2.0, 1.5]), centre, frame),
        outline=MapOutline([[np.array(ring, float).reshape(-1, 3) for ring in (hull, *holes)]]),
    )
