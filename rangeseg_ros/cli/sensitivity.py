"""`rangeseg experiment sensitivity`: how far the constants of the core may move."""

from __future__ import annotations

import re
from pathlib import Path

import click

from rangeseg_ros.cli import options
from rangeseg_ros.cli import tolerances as measures
from rangeseg_ros.evaluation.plots import write_csv
from rangeseg_ros.evaluation.sensitivity import Constant, Trial, find_constants, ranges
from rangeseg_ros.tasks import run_all


@click.command()
@click.argument('folders', metavar='DIR...', nargs=-1, type=options.FOLDER)
@options.params
@options.method
@click.option(
    '--constant',
    'names',
    multiple=True,
    metavar='NAME',
    help='Only this one, e.g. by_planes/patches._CLEAR; may be given several times.',
)
@click.option(
    '--table',
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help='Only those of kind d in this table: docs/method.md.',
)
@click.option(
    '--script',
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help='Python program that prints more figures, 1 at best, as JSON: docs/quality.py.',
)
@click.option(
    '--factor',
    'factors',
    multiple=True,
    type=options.Finite(min=0, min_open=True),
    default=(0.5, 0.71, 1.41, 2.0),
    show_default=True,
    help='What the constants are multiplied with.',
)
@click.option(
    '--together',
    is_flag=True,
    help='Move all of them at once: where that costs nothing, hardly one by itself does.',
)
@click.option(
    '--output',
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help='Folder for sensitivity.csv; made when missing.',
)
@measures.jobs
def command(
    folders: tuple[Path, ...],
    params_file: Path | None,
    method: str | None,
    names: tuple[str, ...],
    table: Path | None,
    script: Path | None,
    factors: tuple[float, ...],
    together: bool,
    output: Path,
    jobs: int | None,
) -> None:
    """How far each constant of the core may move before a set loses 0.003 of mean IoU.

    Every constant is multiplied with every factor, and each DIR, a set that `rangeseg evaluate`
    knows, segmented anew; the kernels that depend on it are compiled for it, which takes from half
    a minute to two. Let it run overnight: interrupted, it resumes. Of terrains it counts what is
    found of ground, obstacles and drops.
    """
    if not folders and not script:
        raise click.UsageError('give a set, DIR, or --script')
    chosen = _chosen(names, table)
    arguments = ['--method', method] if method else []
    if params_file:
        arguments += ['--params', str(params_file.resolve())]
    groups = [tuple(chosen)] if together else [(constant,) for constant in chosen]
    trials = [
        Trial(group, factor, folders, tuple(arguments), output / 'cache', script)
        for factor in (1.0, *factors)
        for group in groups
    ]
    results = list(options.progress(run_all(trials, jobs), len(trials), 'trial'))
    if any(r is None for t, r in zip(trials, results, strict=True) if t.factor == 1):
        raise click.ClickException(
            'sets or script fail: try `rangeseg evaluate`, and the script by itself'
        )
    rows = ranges(trials, results)
    write_csv(output / 'sensitivity.csv', rows)
    for row in rows:
        click.echo(
            f'{row["constant"]}: {row["low"]:g} to {row["high"]:g} times {row["value"]}; '
            f'at worst {row["loss"]:.4f} less ({row["set"]})'
        )


def _chosen(names: tuple[str, ...], table: Path | None) -> list[Constant]:
    known = {str(constant): constant for constant in find_constants()}
    wanted = set(names or known)
    if table:
        rows = re.findall(r'^\| `([\w/]+)` \| `(\w+)` \|[^|]*\| d \|', table.read_text(), re.M)
        if not rows:
            raise click.ClickException(f'{table}: no table of constants')
        wanted &= {'.'.join(row) for row in rows}
    if unknown := sorted(wanted - set(known)):
        raise click.ClickException(f'no constant {unknown[0]}; known: {", ".join(known)}')
    return [constant for name, constant in known.items() if name in wanted]
