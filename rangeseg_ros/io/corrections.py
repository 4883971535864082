"""Corrections of images by files of a sensor: distortion map, and mask of the robot's body."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.options import ConfigError
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.io.distortion import read_distortion
from rangeseg_ros.io.images import read_mask


def _load(read: Callable[[Path], Any], path: Path) -> Any:
    """What `read` makes of a file, kept as long as that does not change."""
    state = path.stat() if path.exists() else None
    return _kept(read, path, state and (state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=8)
def _kept(read: Callable[[Path], Any], path: Path, state: object) -> Any:
    return read(path)


load_mask, load_distortion = partial(_load, read_mask), partial(_load, read_distortion)


def corrected(image: RangeImage, config: Config) -> RangeImage:
    """`image` without the robot's body and the distortion, by the files that `config` names.

    Itself where there are none.

    Raises
    ------
    DistortionError
        The map cannot be read, or is of another size or camera.
    FileError, RangeImageError
        The mask cannot be read, or is of another size.
    """
    if config.mask:
        path = Path(config.mask)
        try:
            image = image.without(load_mask(path))
        except RangeImageError as error:
            raise RangeImageError(f'{path}: {error}') from None
    if config.distortion_map:
        image = load_distortion(Path(config.distortion_map)).corrected(image)
    return image


def check_corrections(config: Config) -> None:
    """Read the files that `corrected` needs, so that none is missed only once a frame is there.

    ConfigError: one that cannot be read, and the parameter that names it.
    """
    for parameter, load in (('mask', load_mask), ('distortion_map', load_distortion)):
        try:
            if file := getattr(config, parameter):
                load(Path(file))
        except (ValueError, OSError) as error:
            raise ConfigError(f'parameter {parameter}: {error}') from None


def correction_files(config: Config) -> list[Path]:
    """Files that `corrected` reads."""
    return [Path(name) for name in (config.distortion_map, config.mask) if name]
