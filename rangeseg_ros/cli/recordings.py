"""What commands that take several recordings share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import click

from rangeseg_ros.cli import options
from rangeseg_ros.cli.errors import one_line
from rangeseg_ros.extras import import_extra
from rangeseg_ros.tasks import Failure, attempt_all, attempt_on_cluster, check_scheduler

R_co = TypeVar('R_co', covariant=True)

argument: Callable[..., Any] = click.argument(
    'paths', metavar='BAG...', nargs=-1, required=True, type=click.Path(path_type=Path)
)
scheduler: Callable[..., Any] = click.option(
    '--scheduler',
    metavar='ADDRESS',
    help='Run on the workers of this Dask cluster, e.g. tcp://host:8786; needs the extra dask. '
    'The workers see BAGs and output under the same names.',
)
of_results = options.together(
    options.topics,
    options.overwrite,
    options.jobs,
    scheduler,
    options.config('exact', 'fixed_frame'),
    click.pass_context,
)
"""Options of commands that write results of recordings."""


class RecordingTask(Protocol[R_co]):
    """A task on one recording."""

    @property
    def recording(self) -> Path:
        """Its file or folder."""

    def run(self, progress: Callable[..., Any] = ...) -> R_co:
        """Do it; `progress` wraps the frames."""


def with_folders(
    recordings: Sequence[Path], output: Path, scheduler: str | None
) -> list[tuple[Path, Path]]:
    """Recordings and the folders of their results; absolute paths for the workers of a cluster."""
    folders = [output]
    if len(recordings) > 1:
        files = '.bag', '.mcap', '.db3'
        names = [path.stem if path.suffix in files else path.name for path in recordings]
        options.check_distinct(names, 'recordings')
        folders = [output / name for name in names]
    if scheduler:
        check_scheduler(scheduler)
        import_extra('distributed')
        recordings, folders = ([p.absolute() for p in paths] for paths in (recordings, folders))
    return list(zip(recordings, folders, strict=True))


def outcomes(
    tasks: Sequence[RecordingTask[R_co]], jobs: int | None, scheduler: str | None
) -> Iterable[R_co | Failure]:
    """Run the tasks on the cluster or on this machine, with a progress bar."""
    if scheduler:
        return options.progress(attempt_on_cluster(tasks, scheduler), len(tasks), 'bag')
    if len(tasks) == 1:
        return [tasks[0].run(lambda frames, total: options.progress(frames, total, 'frame'))]
    return options.progress(attempt_all(tasks, jobs), len(tasks), 'bag')


def report_failure(task: RecordingTask[Any], failure: Failure) -> int:
    """Say why a recording failed; the exit code."""
    click.echo(f'rangeseg: {task.recording}: {one_line(failure.error)}', err=True)
    return 2
