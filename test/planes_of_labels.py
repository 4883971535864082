"""Planes of labels that a test knows, without a segmentation."""

from rangeseg_ros.core.description.planes import describe_regions
from rangeseg_ros.core.fitting.fits import Fits


def fit_planes(labels, image, sensor):
    """Plane of every region, fitted and described as those of a segmentation."""
    return describe_regions(labels, image, Fits.of(labels, image, sensor))
