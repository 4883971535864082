"""Independent tasks on the cores of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import wait
from types import FrameType
from typing import Protocol, TypeVar

import cv2

from rangeseg_ros.interrupts import loses, silence_losses

R_co = TypeVar('R_co', covariant=True)
R = TypeVar('R')

# Errors of the input or of the machine, as opposed to faults of the program.
EXPECTED = (ValueError, OSError, MemoryError)

# Seconds that a worker has to put away what it has begun, and between repeated signals: what a
# signal raises inside compiled code or a destructor may be lost.
_PATIENCE = 10.0
_AGAIN = 0.5


class Task(Protocol[R_co]):
    """Something to be done in any process: it can be pickled."""

    def run(self) -> R_co:
        """Do it, in the same way wherever and however often it is done."""


@dataclass(frozen=True)
class Failure:
    """What came of a task in place of its result: one of the errors `EXPECTED`."""

    error: Exception


class SchedulerError(ValueError):
    """What cannot be the address of a Dask scheduler."""


def run_all(tasks: Sequence[Task[R]], jobs: int | None = None) -> Iterator[R]:
    """Run tasks on all cores (or `jobs` processes); yields their results in order.

    Raises what the first task does that fails; those that have not begun are dropped.
    """
    for result in attempt_all(tasks, jobs):
        if isinstance(result, Failure):
            raise result.error
        yield result


def attempt_all(tasks: Sequence[Task[R]], jobs: int | None = None) -> Iterator[R | Failure]:
    """Run tasks as `run_all` does, each to its result or `Failure`.

    Tasks that are lost with a worker that dies are run again, each by itself.
    """
    jobs = min(jobs or os.cpu_count() or 1, len(tasks))
    if jobs <= 1:
        yield from map(_attempted, tasks)
        return
    results: dict[int, R | Failure] = {}
    given = 0
    for number, result in _completed(tasks, jobs):
        results[number] = result
        while given in results:
            yield results.pop(given)
            given += 1


def _completed(tasks: Sequence[Task[R]], jobs: int) -> Iterator[tuple[int, R | Failure]]:
    """Numbers of tasks and what came of them, in the order in which they end."""
    waiting = deque(range(len(tasks)))
    while waiting:
        running: dict[Future[R | Failure], int] = {}
        with _workers(jobs) as pool, suppress(BrokenProcessPool):
            while waiting or running:
                # No more than there are workers: no others are lost with one of them.
                while waiting and len(running) < jobs:
                    future = pool.submit(_attempted, tasks[waiting[0]])
                    running[future] = waiting.popleft()
                for future in wait_for(running, return_when=FIRST_COMPLETED).done:
                    result = future.result()
                    yield running.pop(future), result
        for number in sorted(running.values()):
            yield number, _attempted_alone(tasks[number])


def _attempted(task: Task[R]) -> R | Failure:
    try:
        return task.run()
    except EXPECTED as error:
        return Failure(error)


def _attempted_alone(task: Task[R]) -> R | Failure:
    # The worker that died may have run another task: two runs alone are decisive.
    for _ in range(2):
        with _workers(1) as pool, suppress(BrokenProcessPool):
            return pool.submit(_attempted, task).result()
    return Failure(OSError('2 workers that ran it have died (out of memory?)'))


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that work on tasks; those in the middle of one put away what they have begun."""
    others = set(multiprocessing.active_children())
    # Spawned, not forked: OpenCV's threads do not survive a fork.
    context = multiprocessing.get_context('spawn')
    pool = ProcessPoolExecutor(count, context, initializer=_begin)
    try:
        yield pool
    finally:
        alive = [child for child in multiprocessing.active_children() if child not in others]
        end = time.monotonic() + _PATIENCE
        while alive and time.monotonic() < end:
            for process in alive:
                process.terminate()
            wait([process.sentinel for process in alive], _AGAIN)
            alive = [process for process in alive if process.is_alive()]
        for process in alive:
            process.kill()
        # Only now: of a broken pool it waits for workers, which are told to end only once.
        pool.shutdown(wait=False, cancel_futures=True)


def _begin() -> None:
    """Prepare a worker: it is interrupted by its parent only, and ends with it."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit)
    silence_losses()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _exit(number: int, stack: FrameType | None) -> None:
    """Raise SystemExit, unless one is on its way and what was begun is being put away."""
    error = sys.exc_info()[1]
    while error and not isinstance(error, SystemExit):
        error = error.__context__
    if not (error or loses(stack)):  # the parent asks again
        raise SystemExit(128 + number)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent:
        wait([parent.sentinel])
        # The parent takes no result any more, which is no error to print.
        sys.stderr = open(os.devnull, 'w')  # noqa: SIM115
        for _ in range(round(_PATIENCE / _AGAIN)):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(_AGAIN)
        os._exit(1)


def check_scheduler(address: str) -> None:
    """Raise SchedulerError unless `address` can be that of a Dask scheduler."""
    pattern = r'((tcp|tls|wss?)://)?([\w.-]+|\[[\da-fA-F:.]+\]):(?P<port>\d{1,5})'
    found = re.fullmatch(pattern, address)
    if not found or not 0 < int(found['port']) < 65536:
        raise SchedulerError(
            f'{address!r} is no address of a Dask scheduler, such as tcp://host:8786'
        )


def attempt_on_cluster(tasks: Sequence[Task[R]], scheduler: str) -> Iterator[R | Failure]:
    """Run tasks on the workers of a Dask cluster, each to its result or `Failure`, in order.

    A task whose worker is lost is run again on another one, up to as many times as Dask's
    `distributed.scheduler.allowed-failures` says. Workers and scheduler need this package, workers
    the same files under the same names. Whoever reaches a scheduler runs code on its workers.
    OSError: no scheduler at that address, or no longer; SchedulerError: not an address.
    """
    check_scheduler(scheduler)
    from distributed import Client, KilledWorker

    with Client(scheduler, set_as_default=False) as client:
        # Not pure: tasks write files, so they run even where Dask knows a result of equal ones.
        futures = client.map(_attempted, tasks, pure=False)
        try:
            for future in futures:
                try:
                    yield future.result()
                except KilledWorker as error:
                    yield Failure(OSError(str(error)))
                except CancelledError:
                    raise OSError(f'{scheduler}: the scheduler is gone') from None
        finally:
            client.cancel(futures)
