"""Planar segmentation of range images by multi-label graph cuts."""

from rangeseg_ros.core.config import Config, ConfigError
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.meaning.roles import ROLES
from rangeseg_ros.core.segmenter import Segmentation, Segmenter
from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.io.distortion import corrected
from rangeseg_ros.messages.clouds import planes_from_message

__version__ = '0.1.0'

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
    '__version__',
    'corrected',
    'planes_from_message',
]
