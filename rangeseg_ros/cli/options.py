"""Options and habits that several commands share."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar

import click
from tqdm import tqdm

from rangeseg_ros import interrupts
from rangeseg_ros.core.config import Config
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.depth_files import Intrinsics
from rangeseg_ros.io.files import NotReplacedError, check_regular, replacing, resolved
from rangeseg_ros.io.params import read_config

T = TypeVar('T')


class Finite(click.FloatRange):
    """A number of a range, and not nan."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f'{number} is not finite.', param, ctx)
        return number

    def _describe_range(self) -> str:
        """Nothing in the help where any number is taken; click writes x<=None there."""
        return '' if self.min is None and self.max is None else super()._describe_range()


FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
EXISTING = click.Path(exists=True, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)

Decorator = Callable[..., Any]


def together(*options: Decorator) -> Decorator:
    """Several options as one decorator, in their order in the help."""

    def decorate(command: Callable[..., Any]) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


def positive(name: str, default: float, text: str, most: float | None = None) -> Decorator:
    """A number above 0."""
    kind = Finite(min=0, min_open=True, max=most)
    return click.option(name, type=kind, default=default, show_default=True, help=text)


def choice(name: str, choices: Sequence[str], text: str) -> Decorator:
    """One of `choices`, by default the first."""
    kind = click.Choice(list(choices))
    return click.option(name, type=kind, default=choices[0], show_default=True, help=text)


count = partial(click.option, type=click.IntRange(min=1), show_default=True)
"""An integer from 1 on."""
number = partial(click.option, type=click.IntRange(min=0), show_default=True)
"""An integer from 0 on."""

camera = partial(
    click.option,
    '--camera',
    'camera_file',
    type=FILE,
    help='Intrinsics: a ROS camera-calibration YAML file, or the JSON of Open3D.',
)
_NUMBERS = {
    '--fx': 'Focal length in x, pixels, in place of a file.',
    '--fy': 'Focal length in y.  [default: as in x]',
    '--cx': 'Column of the principal point.  [default: the middle]',
    '--cy': 'Row of the principal point.  [default: the middle]',
    '--fov': 'Horizontal field of view, degrees, in place of focal lengths.',
}


raw: Decorator = click.option(
    '--raw',
    is_flag=True,
    help='The images are raw: lens distortion D and K count, not P of rectified images.',
)
params: Decorator = click.option(
    '--params',
    'params_file',
    type=FILE,
    help='Parameters of the segmenter: a YAML file of names and values, or of the ROS node.',
)


def _parameter(name: str) -> Decorator:
    """An option for a parameter, by default that of --params."""
    field = Config.__dataclass_fields__[name]
    choices, flag = field.metadata['choices'], field.default is False
    text = str(field.metadata['description'])
    return click.option(
        f'--{name.replace("_", "-")}',
        type=click.Choice(choices) if choices else None,
        is_flag=flag,
        help=f'{text[0].upper()}{text[1:]}.' + ('' if flag else '  [default: as in --params]'),
    )


def config(*names: str) -> Decorator:
    """--params, and options for the parameters `names`, which win; the command gets `config`."""

    def decorate(command: Callable[..., Any]) -> Any:
        @wraps(command)
        def with_config(*args: Any, params_file: Path | None, **given: Any) -> Any:
            named = {name: given.pop(name) for name in names}
            chosen = {name: value for name, value in named.items() if value not in (None, False)}
            return command(*args, config=read_config(params_file, **chosen), **given)

        return together(params, *map(_parameter, names))(with_config)

    return decorate


def intrinsics(command: Callable[..., Any]) -> Any:
    """--camera or numbers in its place, and --raw; the command gets `intrinsics`."""

    @wraps(command)
    def with_intrinsics(
        *args: Any, camera_file: Path | None, raw: bool, fov: float | None, **given: Any
    ) -> Any:
        numbers = [given.pop(name) for name in ('fx', 'fy', 'cx', 'cy')]
        any_number = any(number is not None for number in numbers)
        if (camera_file is not None) + any_number + (fov is not None) > 1:
            raise click.UsageError('give one of --camera, --fx ... --cy and --fov')
        if any_number and numbers[0] is numbers[1] is None:
            raise click.UsageError('--cx and --cy need --fx')
        camera = read_camera(camera_file, raw) if camera_file else None
        known = Intrinsics(camera, numbers if any_number else (), fov)
        return command(*args, intrinsics=known, **given)

    options = [click.option(name, type=Finite(), help=text) for name, text in _NUMBERS.items()]
    return together(camera(), *options, raw)(with_intrinsics)


depth_scale: Decorator = click.option(
    '--depth-scale',
    type=Finite(min=1e-9, max=1e3),
    help='Metres per unit of the images.  [default: 0.001 for integers, 1 for floats]',
)
overwrite: Decorator = click.option(
    '--overwrite', is_flag=True, help='Replace files that are there already.'
)
jobs = count('--jobs', help='Processes.  [default: one for each core]')
topics = together(
    click.option('--depth-topic', help='Depth.  [default: found by type and name]'),
    click.option('--camera-topic', help='Intrinsics.  [default: those beside depth]'),
)


def output_file(name: str, text: str, required: bool = False) -> Decorator:
    """A file to write."""
    kind = click.Path(dir_okay=False, path_type=Path)
    return click.option(name, type=kind, required=required, help=text)


def output_folder(text: str = 'Folder for the results.', required: bool = True) -> Decorator:
    """A folder to write, made when missing."""
    kind = click.Path(file_okay=False, path_type=Path)
    return click.option('--output', type=kind, required=required, help=text)


def _checked_json(
    context: click.Context, parameter: click.Parameter, path: Path | None
) -> Path | None:
    # Before the work that the figures are of.
    if path:
        if not path.parent.is_dir():
            raise click.ClickException(f'{path}: no such folder')
        # As `write_json` writes figures.
        first = b'method' if context.info_name == 'bench' else b'images'
        check_replaceable(path, b'{\n  "' + first + b'"')
    return path


json_file: Decorator = click.option(
    '--json',
    'json_file',
    type=click.Path(dir_okay=False, path_type=Path),
    callback=_checked_json,
    help='Write the figures to this file.',
)


def write_json(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON where there is a file for them, NaN and infinity as null."""
    if path:
        with replacing(path) as partial:
            known = json.loads(json.dumps(figures), parse_constant=lambda _: None)
            partial.write_text(json.dumps(known, indent=2) + '\n')


def check_replaceable(path: Path, beginning: bytes) -> None:
    """Refuse to replace what is no earlier result: a file that does not begin like one."""
    check_regular(path)
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


def check_distinct(names: Iterable[str], what: str) -> None:
    """Refuse inputs of equal names, as results are named after them."""
    name, number = Counter(names).most_common(1)[0]
    if number > 1:
        raise click.UsageError(f'{number} {what} named {name} would write the same results')


def progress(items: Iterable[T], total: int, unit: str) -> Iterable[T]:
    """Show the progress through `items` on a terminal, and nothing elsewhere."""
    with tqdm(items, total=total, unit=unit, disable=None) as bar:
        for item in bar:
            yield item
            interrupts.check()


def say(text: str, err: bool = False) -> None:
    """Print a line, above the bar of `progress`."""
    with tqdm.external_write_mode():
        click.echo(text, err=err)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder that appears under its name once it is complete."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise click.ClickException(f'{path}: exists already, not overwritten')
    with replacing(path) as partial:
        partial.mkdir()
        yield partial
