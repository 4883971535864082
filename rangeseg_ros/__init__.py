"""Planar segmentation of range images by multi-label graph cuts."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rangeseg_ros.core.config import Config
    from rangeseg_ros.core.description.planes import Plane
    from rangeseg_ros.core.ground.roles import ROLES
    from rangeseg_ros.core.mapping.transforms import Transform
    from rangeseg_ros.core.options import ConfigError
    from rangeseg_ros.core.segmentation import Segmentation
    from rangeseg_ros.core.segmenter import Segmenter
    from rangeseg_ros.core.sensing.camera import Camera, CameraError
    from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
    from rangeseg_ros.core.sequence import SequenceSegmenter
    from rangeseg_ros.extras import MissingExtraError
    from rangeseg_ros.io.cameras import camera_from_calibration
    from rangeseg_ros.io.corrections import corrected
    from rangeseg_ros.messages.cameras import camera_from_matrices
    from rangeseg_ros.messages.clouds import planes_from_message
    from rangeseg_ros.notebook import segment

__version__ = '1.0.0'

__all__ = [
    'ROLES',
    'Camera',
    'CameraError',
    'Config',
    'ConfigError',
    'MissingExtraError',
    'Plane',
    'RangeImage',
    'RangeImageError',
    'Segmentation',
    'Segmenter',
    'SequenceSegmenter',
    'Transform',
    '__version__',
    'camera_from_calibration',
    'camera_from_matrices',
    'corrected',
    'planes_from_message',
    'segment',
]

# Imported when used: `rangeseg --help`, and an interrupt at the start, need not wait for numba.
_HOMES = {
    'core.config': ('Config',),
    'core.description.planes': ('Plane',),
    'core.mapping.transforms': ('Transform',),
    'core.ground.roles': ('ROLES',),
    'core.options': ('ConfigError',),
    'core.segmentation': ('Segmentation',),
    'core.segmenter': ('Segmenter',),
    'core.sensing.camera': ('Camera', 'CameraError'),
    'core.sensing.range_image': ('RangeImage', 'RangeImageError'),
    'core.sequence': ('SequenceSegmenter',),
    'extras': ('MissingExtraError',),
    'io.cameras': ('camera_from_calibration',),
    'io.corrections': ('corrected',),
    'messages.cameras': ('camera_from_matrices',),
    'messages.clouds': ('planes_from_message',),
    'notebook': ('segment',),
}
# Of which the first frame has kernels compiled.
_WITH_KERNELS = ('core.segmenter', 'core.sequence', 'notebook')


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            if home in _WITH_KERNELS:
                import_module('rangeseg_ros.compilation')
            return getattr(import_module(f'rangeseg_ros.{home}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return __all__
