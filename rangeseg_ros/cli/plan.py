"""`rangeseg plan`: recordings to floor plans."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import click

from rangeseg_ros.batch.plan import PlanOutcome, PlanTask
from rangeseg_ros.cli import options
from rangeseg_ros.cli import tolerances as measures
from rangeseg_ros.cli.errors import in_words
from rangeseg_ros.cli.replay import result_folders
from rangeseg_ros.tasks import Failure, attempt_all, attempt_on_cluster, check_scheduler


@click.command()
@click.argument(
    'recordings', metavar='RECORDING...', nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option(
    '--output',
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help='Folder for the files; made when missing.',
)
@click.option(
    '--fixed-frame',
    metavar='FRAME',
    help='Frame in which planes stay put.  [default: that of the parameters, or that which the '
    'tf of the recording moves in; without tf, the odometry of the planes]',
)
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
@click.option('--depth-topic', help='Depth images.  [default: found by type and name]')
@click.option('--camera-topic', help='Intrinsics.  [default: camera_info beside the images]')
@options.overwrite
@measures.jobs
@click.option('--scheduler', metavar='ADDRESS', help='As for replay: a Dask cluster.')
@options.params
@options.exact
@click.pass_context
def command(
    ctx: click.Context,
    recordings: tuple[Path, ...],
    output: Path,
    fixed_frame: str | None,
    headroom: float,
    resolution: float,
    depth_topic: str | None,
    camera_topic: str | None,
    overwrite: bool,
    jobs: int | None,
    scheduler: str | None,
    params_file: Path | None,
    exact: bool,
) -> None:
    """Make floor plans and maps of recordings. Needs the extra plan.

    \b
    Writes, into a folder for each recording if there are several:
      plan.svg            walls coloured by standard deviation, openings, floor
      plan.dxf            the same for CAD
      plan.geojson        planes with their outlines, roles and deviations
      plan.html           plan and map, to turn and to measure in
      map.pgm, map.yaml   for map_server of Nav2
      map.ply, map.glb    meshes

    All are in metres in the fixed frame, turned so that z is up where it is not. Walls are made
    exactly square where their covariances allow it.
    """
    missing = [name for name in ('ezdxf', 'trimesh') if find_spec(name) is None]
    if missing:
        raise click.ClickException(f'{" and ".join(missing)} missing: install the extra plan')
    config = options.read_parameters(params_file, exact)
    if fixed_frame is not None:
        config = replace(config, fixed_frame=fixed_frame)
    folders = result_folders(recordings, output)
    if scheduler:
        check_scheduler(scheduler)
        if find_spec('distributed') is None:
            raise click.ClickException('--scheduler needs distributed: install the extra dask')
        recordings = tuple(path.absolute() for path in recordings)
        folders = [folder.absolute() for folder in folders]
    tasks = [
        PlanTask(path, folder, config, headroom, resolution, overwrite, depth_topic, camera_topic)
        for path, folder in zip(recordings, folders, strict=True)
    ]
    for task in tasks:
        task.check()
    if scheduler:
        outcomes = options.progress(attempt_on_cluster(tasks, scheduler), len(tasks), 'bag')
    elif len(tasks) == 1:
        outcomes = [tasks[0].run(lambda frames, n: options.progress(frames, n, 'frame'))]
    else:
        outcomes = options.progress(attempt_all(tasks, jobs), len(tasks), 'bag')
    codes = [_report(task, outcome) for task, outcome in zip(tasks, outcomes, strict=True)]
    if any(codes):
        ctx.exit(max(codes))


def _report(task: PlanTask, outcome: PlanOutcome | Failure) -> int:
    """Say what became of a recording; the exit code."""
    if isinstance(outcome, Failure):
        click.echo(f'rangeseg: {task.recording}: {in_words(outcome.error)}', err=True)
        return 2
    for warning in outcome.warnings:
        click.echo(f'rangeseg: {task.recording}: {warning}', err=True)
    click.echo(
        f'{task.folder}: {outcome.located} of {outcome.frames} frames in {outcome.frame}, up by '
        f'{outcome.up}: {outcome.planes} planes, {outcome.walls} upright, '
        f'{outcome.squared} of them square, {outcome.openings} openings'
    )
    return 0
