"""Corrections of images by files of a sensor: distortion map, and mask of the robot's body."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.options import ConfigError
from rangeseg_ros.core.sensing.distortion import DistortionError
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.io import distortion
from rangeseg_ros.io.images import ImageFileError, read_mask


def corrected(image: RangeImage, config: Config) -> RangeImage:
    """`image` without the robot's body and the distortion, by the files that `config` names.

    Itself where there are none.

    Raises
    ------
    DistortionError
        The map cannot be read, or is of another size or camera.
    ImageFileError, RangeImageError
        The mask cannot be read, or is of another size.
    """
    if config.mask:
        path = Path(config.mask)
        try:
            image = image.without(_mask(path))
        except RangeImageError as error:
            raise RangeImageError(f'{path}: {error}') from None
    if config.distortion_map:
        image = distortion.load(Path(config.distortion_map)).corrected(image)
    return image


def check_corrections(config: Config) -> None:
    """Read the files that `corrected` needs, so that none is missed only once a frame is there.

    Raises
    ------
    ConfigError
        One that cannot be read, and the parameter that names it.
    """
    for parameter, file, read in (
        ('mask', config.mask, _mask),
        ('distortion_map', config.distortion_map, distortion.load),
    ):
        try:
            if file:
                read(Path(file))
        except (ImageFileError, DistortionError) as error:
            raise ConfigError(f'parameter {parameter}: {error}') from None


def correction_files(config: Config) -> list[Path]:
    """Files that `corrected` reads."""
    return [Path(name) for name in (config.distortion_map, config.mask) if name]


def _mask(path: Path) -> NDArray[np.bool_]:
    """Read a mask, once as long as the file does not change."""
    try:
        state = path.stat()
    except OSError as error:
        raise ImageFileError(f'{path}: {error.strerror}') from None
    return _kept(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=4)
def _kept(path: Path, time: int, size: int) -> NDArray[np.bool_]:
    return read_mask(path)
