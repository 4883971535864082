"""Independent tasks on the cores of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Protocol, TypeVar

import cv2

from rangeseg_ros.interrupts import silence_losses

R_co = TypeVar('R_co', covariant=True)
R = TypeVar('R')

# What tells of bad input or of a machine at its limits, and not of a fault of the program.
EXPECTED = (ValueError, OSError, MemoryError)

# A task is given to so many workers before it is held to be what ends them.
_WORKERS_PER_TASK = 2
# Seconds that a worker has to put away what it has begun, and between telling it again: what a
# signal raises inside compiled code or a destructor may be lost.
_PATIENCE = 10.0
_AGAIN = 0.5


class Task(Protocol[R_co]):
    """Something to be done in any process: it can be pickled."""

    def run(self) -> R_co:
        """Do it, in the same way wherever and however often it is done."""


@dataclass(frozen=True)
class Failure:
    """What came of a task in place of its result.

    Attributes
    ----------
    error : Exception
        A ValueError, an OSError or a MemoryError.
    """

    error: Exception


class SchedulerError(ValueError):
    """What cannot be the address of a Dask scheduler."""


def run_all(tasks: Sequence[Task[R]], jobs: int | None = None) -> Iterator[R]:
    """Run tasks on all cores (or `jobs` processes); yields their results in order.

    Raises
    ------
    ValueError, OSError, MemoryError
        The first task's that fails; those that have not begun are dropped.
    """
    return map(_successful, attempt_all(tasks, jobs))


def attempt_all(tasks: Sequence[Task[R]], jobs: int | None = None) -> Iterator[R | Failure]:
    """Run tasks as `run_all` does, each to its result or `Failure`.

    A task whose worker dies is given to another one, once. Workers end when this process does,
    whatever ends it.
    """
    jobs = min(jobs or os.cpu_count() or 1, len(tasks))
    if jobs <= 1:
        yield from map(_attempted, tasks)
        return
    pool = _Pool(jobs)
    waiting = deque(range(len(tasks)))
    deaths: Counter[int] = Counter()
    done: dict[int, Any] = {}
    try:
        for index in range(len(tasks)):
            while index not in done:
                while waiting and pool.free():
                    pool.give(waiting[0], tasks[waiting[0]])
                    waiting.popleft()
                for number, result in pool.results():
                    if not isinstance(result, _Death):
                        done[number] = result
                    elif deaths[number] + 1 < _WORKERS_PER_TASK:
                        deaths[number] += 1
                        waiting.appendleft(number)
                    else:
                        done[number] = Failure(OSError(str(result)))
            yield done.pop(index)
    finally:
        pool.end()


@dataclass(frozen=True)
class _Death:
    """Of a worker, in place of a result."""

    code: int | None

    def __str__(self) -> str:
        how = f'with code {self.code}'
        if self.code and self.code < 0:
            how = f'by signal {-self.code}'
        return f'{_WORKERS_PER_TASK} workers ended {how} (out of memory?)'


class _Pool:
    """Spawned processes that work on one task each."""

    def __init__(self, size: int) -> None:
        self._size = size
        # Spawned, not forked: OpenCV's threads do not survive a fork.
        self._context = multiprocessing.get_context('spawn')
        self._idle: list[tuple[Connection, SpawnProcess]] = []
        self._busy: dict[Connection, tuple[SpawnProcess, int]] = {}

    def free(self) -> bool:
        """Whether a task can be given."""
        return len(self._busy) < self._size

    def give(self, number: int, task: Task[Any]) -> None:
        """Have a worker begin a task."""
        connection, process = self._idle.pop() if self._idle else self._start()
        # Of a worker that died while it had nothing to do, `results` tells as of any other.
        self._busy[connection] = process, number
        try:
            connection.send(task)
        except OSError:
            process.join()

    def results(self) -> Iterator[tuple[int, Any]]:
        """Wait for workers to finish: the numbers of their tasks, and what came of them."""
        for connection in wait(list(self._busy)):
            assert isinstance(connection, Connection)
            process, number = self._busy.pop(connection)
            try:
                result = connection.recv()
            except (EOFError, OSError):
                process.join()
                connection.close()
                yield number, _Death(process.exitcode)
                continue
            self._idle.append((connection, process))
            if isinstance(result, _Fault):
                raise result.error from RuntimeError(result.trace)
            yield number, result

    def end(self) -> None:
        """End all workers; those in the middle of a task put away what they have begun."""
        workers = {process: c for c, process in self._idle}
        workers.update((process, c) for c, (process, _) in self._busy.items())
        for connection in workers.values():
            connection.close()
        alive = list(workers)
        end = time.monotonic() + _PATIENCE
        while alive and time.monotonic() < end:
            for process in alive:
                process.terminate()
            wait([process.sentinel for process in alive], _AGAIN)
            alive = [process for process in alive if process.is_alive()]
        for process in alive:
            process.kill()
            process.join()

    def _start(self) -> tuple[Connection, SpawnProcess]:
        here, there = self._context.Pipe()
        process = self._context.Process(target=_work, args=(there,), daemon=True)
        process.start()
        there.close()
        return here, process


@dataclass(frozen=True)
class _Fault:
    """An error of the program in a worker."""

    error: Exception
    trace: str


def _work(connection: Connection) -> None:
    """Do tasks until there are no more."""
    cv2.setNumThreads(1)
    # Interrupted by its parent only.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit)
    silence_losses()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        while True:
            try:
                task = connection.recv()
            except (EOFError, OSError):
                return
            # A parent that has gone wants no result; the next `recv` says so.
            with suppress(ConnectionError):
                try:
                    connection.send(_attempted(task))
                except Exception as error:
                    import traceback

                    connection.send(_Fault(error, traceback.format_exc()))
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _exit(number: int, stack: object) -> None:
    """Raise SystemExit, unless one is on its way and what was begun is being put away."""
    error = sys.exc_info()[1]
    while error and not isinstance(error, SystemExit):
        error = error.__context__
    if not error:
        raise SystemExit(128 + number)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent:
        wait([parent.sentinel])
        for _ in range(round(_PATIENCE / _AGAIN)):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(_AGAIN)
        os._exit(1)


def _attempted(task: Task[R]) -> R | Failure:
    try:
        return task.run()
    except EXPECTED as error:
        return Failure(error)


def _successful(result: R | Failure) -> R:
    if isinstance(result, Failure):
        raise result.error
    return result


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

    Parameters
    ----------
    tasks : sequence of Task
    scheduler : str
        Address of the scheduler, e.g. 'tcp://host:8786'.

    Raises
    ------
    ImportError
        `distributed` is not installed.
    SchedulerError
        Not an address.
    OSError
        No scheduler at that address, or no longer.
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
