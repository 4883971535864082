"""Compiled kernels on several threads: they release the interpreter while they run.

Threads of our own and none of numba's: those do not survive a fork, and the default ones may not
be entered from two threads. There are as many as OpenCV uses, so that `cv2.setNumThreads` sets
both. Nor those of `concurrent.futures`: most tasks take less than a millisecond, of which waking
a thread is a good part. Here whoever needs a task that no helper has begun does it by itself.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from queue import SimpleQueue
from threading import Lock, Thread
from typing import Any, Generic, TypeVar

import cv2

T = TypeVar('T')

# More would wait for the memory.
_MAX_THREADS = 4
# Rows that are worth the handing over, and strips for each thread: who is done first, as its rows
# are the easier ones or as it was awake sooner, takes one more.
_ROWS, _STRIPS = 16, 2
# Rows on either side of the middle of the image that are looked at again.
_SEAM = 8


class Task(Generic[T]):
    """A call that a helper makes, or whoever asks for its result before that."""

    def __init__(self, function: Callable[..., T], arguments: tuple[Any, ...]) -> None:
        self._function, self._arguments = function, arguments
        self._begun, self._over = Lock(), Lock()
        self._over.acquire()
        self._error: BaseException | None = None

    def run(self) -> None:
        """Make the call, unless somebody has begun to."""
        if not self._begun.acquire(blocking=False):
            return
        try:
            self._value = self._function(*self._arguments)
        except BaseException as error:
            self._error = error
        self._over.release()

    def result(self) -> T:
        """What the call returns or raises; waits for it if a helper is at it."""
        self.run()
        with self._over:
            if self._error is not None:
                raise self._error
            return self._value


class _Helpers:
    """Threads that take tasks, as many as there may be at work beside the caller's."""

    def __init__(self) -> None:
        self._tasks: SimpleQueue[Task[Any] | None] = SimpleQueue()
        self._threads: list[Thread] = []
        self._lock = Lock()

    def add(self, task: Task[Any]) -> None:
        with self._lock:
            if len(self._threads) < min(cv2.getNumThreads(), _MAX_THREADS) - 1:
                name = f'rangeseg_{len(self._threads)}'
                self._threads.append(Thread(target=self._work, name=name, daemon=True))
                self._threads[-1].start()
        self._tasks.put(task)

    def end(self) -> None:
        """Have the threads end: none may be at work when the interpreter is no more."""
        for _ in self._threads:
            self._tasks.put(None)
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        while task := self._tasks.get():
            task.run()
            del task


@cache
def _helpers() -> _Helpers:
    return _Helpers()


@atexit.register
def _end_helpers() -> None:
    _helpers().end()


if hasattr(os, 'register_at_fork'):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=_helpers.cache_clear)


_sharing = 0
_lock = Lock()


@contextmanager
def sharing_cores() -> Iterator[None]:
    """Work on one of several frames: threads that do so at the same time share the cores.

    Where there is one core for each of them, they have no helpers, which would take from one frame
    what they give to another.
    """
    global _sharing
    with _lock:
        _sharing += 1
    try:
        yield
    finally:
        with _lock:
            _sharing -= 1


def _cores() -> int:
    return cv2.getNumThreads() // max(_sharing, 1)


def run_rows(
    kernel: Callable[..., None], rows: int, *arguments: Any, strips: int = _STRIPS
) -> None:
    """Run kernel(first, after, *arguments) on strips of the rows at the same time.

    What one strip writes no other may touch: then the result is the same for any number of
    threads, and of strips for each.
    """
    threads = min(_cores(), _MAX_THREADS)
    count = max(min(strips * threads, rows // _ROWS), 1) if threads > 1 else 1
    bounds = [rows * part // count for part in range(count + 1)]
    others = [
        _handed_over(kernel, first, after, *arguments) for first, after in pairwise(bounds[1:])
    ]
    kernel(0, bounds[1], *arguments)
    for other in others:
        other.run()
    for other in others:
        other.result()


def map_halves(kernel: Callable[..., T], rows: int, *arguments: Any) -> tuple[T, T]:
    """Results of kernel(first, after, *arguments) for the upper and the lower half of the rows.

    These halves, whatever the number of threads: sums over them always round alike.
    """
    middle = rows // 2
    lower = submit(kernel, middle, rows, *arguments)
    return kernel(0, middle, *arguments), lower.result()


def run_halves(kernel: Callable[..., None], height: int, *arguments: Any) -> None:
    """Run kernel(rows, *arguments) on both halves of an image at once, then where they meet.

    Two rows in the middle are left to the end, so that neither half sees the other change: the
    result is the same for any number of threads.
    """
    middle = height // 2
    lower = submit(kernel, (min(middle + 1, height), height), *arguments)
    kernel((0, max(middle - 1, 0)), *arguments)
    lower.result()
    kernel((max(middle - _SEAM, 0), min(middle + _SEAM, height)), *arguments)


def submit(task: Callable[..., T], *arguments: Any) -> Task[T]:
    """Start a task beside what the caller does until `result()`, or do it with a single core."""
    if _cores() > 1:
        return _handed_over(task, *arguments)
    done = Task(task, arguments)
    done.run()
    return done


def _handed_over(task: Callable[..., T], *arguments: Any) -> Task[T]:
    given = Task(task, arguments)
    _helpers().add(given)
    return given
