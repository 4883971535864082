"""`rangeseg plan`: recordings to floor plans."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rangeseg_ros.batch.plan import PlanOutcome, PlanTask
from rangeseg_ros.cli import options, recordings
from rangeseg_ros.extras import import_extra
from rangeseg_ros.tasks import Failure


@click.command()
@recordings.argument
@options.output_folder()
@click.option(
    '--headroom',
    type=options.Finite(min=0.1, max=100),
    default=2.0,
    show_default=True,
    help='Height above the ground up to which things are in the way, metres.',
)
@click.option(
    '--resolution',
    type=options.Finite(min=0.005, max=1),
    default=0.05,
    show_default=True,
    help='Side of a cell of map.pgm, metres.',
)
@recordings.of_results
def command(
    ctx: click.Context,
    paths: tuple[Path, ...],
    output: Path,
    jobs: int | None,
    scheduler: str | None,
    **settings: Any,
) -> None:
    """Make floor plans and maps of recordings. Needs the extra plan.

    \b
    Writes, into a folder for each recording if there are several:
      plan.svg            walls coloured by standard deviation, openings, floor, stairs
      plan.dxf            the same for CAD
      plan.geojson        planes with their outlines, roles and deviations
      plan.html           plan and map, to turn and to measure in
      map.pgm, map.yaml   for map_server of Nav2
      map.ply, map.glb    meshes

    All are in metres in the fixed frame, turned so that z is up where it is not; without
    --fixed-frame in that which the tf of the recording moves in, without tf in the odometry of the
    planes. Walls are made exactly square where their covariances allow it.
    """
    for library in ('ezdxf', 'trimesh'):
        import_extra(library)
    tasks = [
        PlanTask(path, folder, **settings)
        for path, folder in recordings.with_folders(paths, output, scheduler)
    ]
    for task in tasks:
        task.check()
    outcomes = recordings.outcomes(tasks, jobs, scheduler)
    codes = [_report(task, outcome) for task, outcome in zip(tasks, outcomes, strict=True)]
    if any(codes):
        ctx.exit(max(codes))


def _report(task: PlanTask, outcome: PlanOutcome | Failure) -> int:
    """Say what became of a recording; the exit code."""
    if isinstance(outcome, Failure):
        return recordings.report_failure(task, outcome)
    for warning in outcome.warnings:
        click.echo(f'rangeseg: {task.recording}: {warning}', err=True)
    click.echo(
        f'{task.folder}: {outcome.located} of {outcome.frames} frames in {outcome.frame}, up by '
        f'{outcome.up}: {outcome.content}'
    )
    return 0
