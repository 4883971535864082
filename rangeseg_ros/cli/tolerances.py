"""What `compare` and `evaluate` have in common: tolerances, and figures in files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from rangeseg_ros.cli.options import check_replaceable
from rangeseg_ros.evaluation.figures import TOLERANCES, as_json
from rangeseg_ros.evaluation.overlap import check_tolerance
from rangeseg_ros.io.files import replacing


class ToleranceCommand(click.Command):
    """A command whose `--tolerance` takes all the numbers that follow it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        spread: list[str] = []
        taking = False
        for arg in args:
            number = _is_number(arg)
            if taking and number and spread[-1] != '--tolerance':
                spread.append('--tolerance')
            taking = arg == '--tolerance' or (taking and number)
            spread.append(arg)
        return super().parse_args(ctx, spread)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _checked(
    context: click.Context, parameter: click.Parameter, values: tuple[float, ...]
) -> tuple[float, ...]:
    return tuple(check_tolerance(value) for value in values or TOLERANCES)


tolerance = click.option(
    '--tolerance',
    'tolerances',
    type=float,
    multiple=True,
    callback=_checked,
    metavar='T...',
    help=f'Overlap from which regions match, in (0.5, 1]; several may follow.  '
    f'[default: {" ".join(map(str, TOLERANCES))}]',
)


def _checked_output(
    context: click.Context, parameter: click.Parameter, path: Path | None
) -> Path | None:
    # Before the work that the figures are of.
    if path:
        check_replaceable(path, b'{')
    return path


json_file = click.option(
    '--json',
    'json_file',
    type=click.Path(path_type=Path),
    callback=_checked_output,
    help='Write the figures to this file.',
)

jobs = click.option(
    '--jobs', type=click.IntRange(min=1), help='Processes.  [default: one for each core]'
)


def write_json(path: Path, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON, undefined ones as null."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(as_json(figures), indent=2) + '\n')
