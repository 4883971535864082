"""Options and habits that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click
from tqdm import tqdm

from rangeseg_ros import interrupts
from rangeseg_ros.core.config import Config
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.depth_files import Intrinsics
from rangeseg_ros.io.files import (
    NotReplacedError,
    check_regular,
    clear_abandoned,
    replacing,
    resolved,
)
from rangeseg_ros.io.params import read_config

T = TypeVar('T')


class _RegularFile(click.Path):
    """A file that can be read to its end: no pipe, no device."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = Path(str(super().convert(value, param, ctx)))
        if not path.is_file():
            self.fail(f'{path} is not a regular file.', param, ctx)
        return path


class Finite(click.FloatRange):
    """A number of a range, and not nan."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f'{number} is not finite.', param, ctx)
        return number


FILE = _RegularFile(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)

camera: Callable[..., Any] = click.option(
    '--camera',
    'camera_file',
    type=FILE,
    required=True,
    help='Intrinsics: a ROS camera-calibration YAML file.',
)
_NUMBERS = (
    ('--fx', 'Focal length in x, pixels, in place of a file.'),
    ('--fy', 'Focal length in y.  [default: as in x]'),
    ('--cx', 'Column of the principal point.  [default: the middle]'),
    ('--cy', 'Row of the principal point.  [default: the middle]'),
    ('--fov', 'Horizontal field of view, degrees, in place of focal lengths.'),
)


def intrinsics(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options for `--camera` or for numbers in its place: `camera_file`, `fx` ... `fov`."""
    for name, told in reversed(_NUMBERS):
        command = click.option(name, type=Finite(), help=told)(command)
    file = click.option(
        '--camera',
        'camera_file',
        type=FILE,
        help='Intrinsics: a ROS camera-calibration YAML file, or the JSON of Open3D.',
    )
    decorated: Callable[..., Any] = file(command)
    return decorated


def read_intrinsics(
    camera_file: Path | None, raw: bool, numbers: Sequence[float | None], fov: float | None
) -> Intrinsics:
    """Intrinsics of the options `intrinsics`; `numbers` are fx, fy, cx, cy."""
    given = any(number is not None for number in numbers)
    if (camera_file is not None) + given + (fov is not None) > 1:
        raise click.UsageError('give one of --camera, --fx ... --cy and --fov')
    if given and not (numbers[0] or numbers[1]):
        raise click.UsageError('--cx and --cy need --fx')
    camera = read_camera(camera_file, raw) if camera_file else None
    return Intrinsics(camera, numbers if given else (), fov)


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
    type=Finite(min=1e-9, max=1e3),
    help='Metres per unit of the images.  [default: 0.001 for integers, 1 for floats]',
)
overwrite: Callable[..., Any] = click.option(
    '--overwrite', is_flag=True, help='Replace files that are there already.'
)


def check_replaceable(path: Path, beginning: bytes) -> None:
    """Refuse to replace what is no earlier result: a file that does not begin like one.

    Also what is no regular file, and a file in a folder that is not there.
    """
    check_regular(path)
    if not path.parent.is_dir():
        raise click.ClickException(f'{path}: no such folder')
    if path.is_file() and path.stat().st_size:
        with path.open('rb') as file:
            if file.read(len(beginning)) != beginning:
                raise NotReplacedError(path)


def check_new(paths: Iterable[Path], inputs: Iterable[Path], overwrite: bool) -> None:
    """Refuse to write over the inputs of a command, and without `overwrite` over anything."""
    taken = {resolved(path) for path in inputs}
    for path in paths:
        if resolved(path) in taken:
            raise NotReplacedError(path, 'is an input, not overwritten')
        if not overwrite and path.exists():
            raise NotReplacedError(path, 'exists already, not overwritten (see --overwrite)')


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
    clear_abandoned(path)
    with replacing(path) as partial:
        partial.mkdir()
        yield partial
