"""`rangeseg replay`: recordings to labels, planes, bags and reports."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from rangeseg_ros.batch.replay import Outcome, Replay
from rangeseg_ros.cli import options, recordings
from rangeseg_ros.cli.errors import one_line
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.files import NotReplacedError
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.report.page import page_kind
from rangeseg_ros.report.replay import write_overview
from rangeseg_ros.tasks import Failure


@click.command()
@recordings.argument
@options.output_folder()
@options.camera()
@options.raw
@click.option(
    '--topic',
    'topics',
    type=click.Choice(list(OUTPUTS)),
    multiple=True,
    default=Replay.topics,
    show_default=True,
    help='Topic of the node to write into the bag; several may be given.',
)
@click.option(
    '--terrain',
    is_flag=True,
    help='Also write <frame>_<stamp>_terrain.png and _height.tiff, ground.csv and stairs.csv.',
)
@click.option('--copy', is_flag=True, help='Copy the topics of the recording into the bag.')
@recordings.of_results
def command(
    ctx: click.Context,
    paths: tuple[Path, ...],
    output: Path,
    overwrite: bool,
    topics: tuple[str, ...],
    camera_file: Path | None,
    jobs: int | None,
    scheduler: str | None,
    **settings: Any,
) -> None:
    """Segment the depth images of recordings: rosbag2 (mcap, sqlite3) and ROS 1 bags.

    \b
    Writes, into a folder for each recording if there are several:
      <frame>_<stamp>_labels.png    16 bits, 0 = no plane
      <frame>_<stamp>_overlay.png   planes in colour
      planes.csv                    a row for each plane and frame
      bag                           what the node would publish (mcap)
      map.csv, map.ply              the map of planes: a row each, and a mesh
      trajectory.txt                the camera's motion, with the parameter odometry (TUM)
      report.html                   pictures, planes over time, times

    Several recordings have index.html beside their folders, which leads to their reports.
    A recording that is done is not done again, one that was interrupted starts anew. What of a
    recording is damaged is left out, and the exit code is 1; a recording that fails costs no
    other, and the exit code is 2.
    """
    settings |= {'topics': tuple(name for name in OUTPUTS if name in topics)}
    camera = read_camera(camera_file, settings['raw']) if camera_file else None
    tasks = [
        Replay(bag, folder, overwrite=overwrite, camera=camera, **settings)
        for bag, folder in recordings.with_folders(paths, output, scheduler)
    ]
    # All are opened, and so checked, before anything is written.
    index = output / 'index.html'
    if len(tasks) > 1 and index.exists() and not overwrite and page_kind(index) != 'overview':
        raise NotReplacedError(index)
    found = [task.check() for task in tasks]
    outcomes = recordings.outcomes(tasks, jobs, scheduler)
    rows, codes = [], []
    for task, read, outcome in zip(tasks, found, outcomes, strict=True):
        click.echo(f'{task.recording}: {read}')
        codes.append(_report(task, outcome))
        rows.append(_row(task, outcome))
    if len(tasks) > 1:
        write_overview(index, output.name, rows)
    if any(codes):
        ctx.exit(max(codes))


def _row(task: Replay, outcome: Outcome | Failure) -> dict[str, Any]:
    """Row of a recording in the overview."""
    row = {'name': task.folder.name, 'failed': isinstance(outcome, Failure)}
    if isinstance(outcome, Failure):
        nothing = dict.fromkeys(('frames', 'empty', 'duration', 'planes_per_frame', 'ids'), 0)
        return {**row, **nothing, 'damage': one_line(outcome.error)}
    return {**row, **asdict(outcome), **outcome.figures}


def _report(task: Replay, outcome: Outcome | Failure) -> int:
    """Say what became of a recording; the exit code."""
    if isinstance(outcome, Failure):
        return recordings.report_failure(task, outcome)
    for note in outcome.notes:
        click.echo(note)
    for warning in outcome.warnings:
        click.echo(f'rangeseg: {warning}', err=True)
    mapped = f', {outcome.mapped} planes in the map' if task.config.map_frame else ''
    already = ', done before' if outcome.already_done else ''
    click.echo(f'{task.folder}: {outcome.frames} frames{mapped}{already}')
    if outcome.damage:
        click.echo(f'rangeseg: {outcome.damage}', err=True)
    return 1 if outcome.damage else 0
