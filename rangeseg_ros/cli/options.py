"""Options and habits that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click
from tqdm import tqdm

from rangeseg_ros.cli import interrupts
from rangeseg_ros.core.config import Config
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.params import read_config

T = TypeVar('T')

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)

camera: Callable[..., Any] = click.option(
    '--camera',
    'camera_file',
    type=FILE,
    required=True,
    help='Intrinsics: a ROS camera-calibration YAML file.',
)
raw: Callable[..., Any] = click.option(
    '--raw',
    is_flag=True,
    help='The images are raw: lens distortion D and K count, not P of rectified images.',
)
params: Callable[..., Any] = click.option(
    '--params',
    'params_file',
    type=FILE,
    help='Parameters of the segmenter: a YAML file of names and values, or of the ROS node.',
)
method: Callable[..., Any] = click.option(
    '--method',
    type=click.Choice(Config.__dataclass_fields__['method'].metadata['choices']),
    help='Method, in place of that of the parameters.',
)
exact: Callable[..., Any] = click.option(
    '--exact',
    is_flag=True,
    help='Minimise with every label at full resolution instead of coarse to fine: slow.',
)
depth_scale: Callable[..., Any] = click.option(
    '--depth-scale',
    type=click.FloatRange(min=0, min_open=True),
    help='Metres per unit of the images.  [default: 0.001 for integers, 1 for floats]',
)


def progress(items: Iterable[T], total: int, unit: str) -> Iterable[T]:
    """Show the progress through `items` on a terminal, and nothing elsewhere."""
    with tqdm(items, total=total, unit=unit, disable=None) as bar:
        for item in bar:
            yield item
            interrupts.check()


def read_parameters(params_file: Path | None, exact: bool) -> Config:
    """Config of the options `params` and `exact`; the latter wins over the file."""
    return read_config(params_file, **({'exact': True} if exact else {}))


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder that appears under its name once it is complete."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise click.ClickException(f'{path}: exists already, not overwritten')
    with replacing(path) as partial:
        partial.mkdir()
        yield partial
