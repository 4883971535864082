"""Planar segmentation of range images by multi-label graph cuts."""

from rangeseg_ros.core.camera import Camera, CameraError
from rangeseg_ros.core.config import Config, ConfigError
from rangeseg_ros.core.planes import Plane
from rangeseg_ros.core.range_image import RangeImage, RangeImageError
from rangeseg_ros.core.roles import ROLES
from rangeseg_ros.core.segmenter import Segmentation, Segmenter
from rangeseg_ros.ros.clouds import planes_from_message

__all__ = [
    'ROLES',
    'Camera',
    'CameraError',
    'Config',
    'ConfigError',
    'Plane',
    'RangeImage',
    'RangeImageError',
    'Segmentation',
    'Segmenter',
    'planes_from_message',
]
