"""Planar segmentation of range images by multi-label graph cuts."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rangeseg_ros.core.config import Config as Config
    from rangeseg_ros.core.description.planes import Plane as Plane
    from rangeseg_ros.core.ground.roles import ROLES as ROLES
    from rangeseg_ros.core.mapping.transforms import Transform as Transform
    from rangeseg_ros.core.options import ConfigError as ConfigError
    from rangeseg_ros.core.segmentation import Segmentation as Segmentation
    from rangeseg_ros.core.segmenter import Segmenter as Segmenter
    from rangeseg_ros.core.sensing.camera import Camera as Camera
    from rangeseg_ros.core.sensing.camera import CameraError as CameraError
    from rangeseg_ros.core.sensing.range_image import RangeImage as RangeImage
    from rangeseg_ros.core.sensing.range_image import RangeImageError as RangeImageError
    from rangeseg_ros.core.sensing.range_image import UnitWarning as UnitWarning
    from rangeseg_ros.core.sequence import SequenceSegmenter as SequenceSegmenter
    from rangeseg_ros.extras import MissingExtraError as MissingExtraError
    from rangeseg_ros.io.cameras import camera_from_calibration as camera_from_calibration
    from rangeseg_ros.io.corrections import corrected as corrected
    from rangeseg_ros.messages.cameras import camera_from_matrices as camera_from_matrices
    from rangeseg_ros.messages.clouds import planes_from_message as planes_from_message
    from rangeseg_ros.notebook import segment as segment

__version__ = '1.0.0'

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
    'core.sensing.range_image': ('RangeImage', 'RangeImageError', 'UnitWarning'),
    'core.sequence': ('SequenceSegmenter',),
    'extras': ('MissingExtraError',),
    'io.cameras': ('camera_from_calibration',),
    'io.corrections': ('corrected',),
    'messages.cameras': ('camera_from_matrices',),
    'messages.clouds': ('planes_from_message',),
    'notebook': ('segment',),
}
__all__ = ['__version__', *(name for names in _HOMES.values() for name in names)]
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
