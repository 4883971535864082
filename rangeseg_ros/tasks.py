"""Independent tasks on the cores of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from typing import Protocol, TypeVar

import cv2

R_co = TypeVar('R_co', covariant=True)
R = TypeVar('R')


class Task(Protocol[R_co]):
    """Something to be done in any process: it can be pickled."""

    def run(self) -> R_co:
        """Do it, in the same way wherever and however often it is done."""


def run_all(tasks: Sequence[Task[R]], jobs: int | None = None) -> Iterator[R]:
    """Run tasks on all cores (or `jobs` processes); yields their results in order.

    Raises
    ------
    ValueError, OSError
        The first task's that fails; those that have not begun are dropped.
    """
    jobs = min(jobs or os.cpu_count() or 1, len(tasks))
    if jobs <= 1:
        yield from map(_run, tasks)
        return
    # Spawned, not forked: OpenCV's threads do not survive a fork.
    context = multiprocessing.get_context('spawn')
    with ExitStack() as stack:
        pool = ProcessPoolExecutor(jobs, context, initializer=_begin)
        stack.callback(pool.shutdown, cancel_futures=True)
        yield from pool.map(_run, tasks)


def run_on_cluster(tasks: Sequence[Task[R]], scheduler: str) -> Iterator[R]:
    """Run tasks on the workers of a Dask cluster; yields their results in order.

    A task whose worker is lost is run again on another one, up to as many times as Dask's
    `distributed.scheduler.allowed-failures` says. Workers need this package, and the same files
    under the same names.

    Parameters
    ----------
    tasks : sequence of Task
    scheduler : str
        Address of the scheduler, e.g. 'tcp://host:8786'.

    Raises
    ------
    ImportError
        `distributed` is not installed.
    OSError
        No scheduler at that address, or a task that has lost too many workers.
    ValueError, OSError
        The first task's that fails; those that have not begun are dropped.
    """
    from distributed import Client, KilledWorker

    with Client(scheduler, set_as_default=False) as client:
        # Not pure: tasks write files, so they run even where Dask knows a result of equal ones.
        futures = client.map(_run, tasks, pure=False)
        try:
            for future in futures:
                yield future.result()
        except KilledWorker as error:
            raise OSError(str(error)) from None
        finally:
            client.cancel(futures)


def _begin() -> None:
    """Set up a worker process: one OpenCV thread; interrupts are its parent's to handle."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(task: Task[R]) -> R:
    return task.run()
