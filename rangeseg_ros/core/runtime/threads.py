"""Compiled kernels on several threads: they release the interpreter while they run.

Not threads of numba's: those do not survive a fork, and the default ones may not be entered from
two threads. There are as many as OpenCV uses, so that `cv2.setNumThreads` sets both. Most tasks
take less than a millisecond, of which waking a thread is a good part: whoever needs the result of
a task that no thread has begun works it out itself.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from threading import Lock
from typing import Any, Generic, TypeVar

import cv2

T = TypeVar('T')

# More would wait for the memory.
_MAX_THREADS = 4
# Rows on either side of the middle of the image that are looked at again.
_SEAM = 8


class Task(Generic[T]):
    """A call that a thread of the pool makes, or whoever asks for its result before that."""

    def __init__(self, function: Callable[..., T], *arguments: Any) -> None:
        self._call = partial(function, *arguments)
        self._future: Future[T] | None = None
        if cv2.getNumThreads() // max(_sharing, 1) > 1:
            self._future = _pool(min(cv2.getNumThreads(), _MAX_THREADS) - 1).submit(self._call)

    def run(self) -> None:
        """Make the call here, unless a thread has begun it."""
        if self._future is None or self._future.cancel():
            self._future = Future()
            try:
                self._future.set_result(self._call())
            except BaseException as error:
                self._future.set_exception(error)

    def result(self) -> T:
        """What the call returns or raises."""
        self.run()
        assert self._future is not None
        return self._future.result()


@cache
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix='rangeseg')


if hasattr(os, 'register_at_fork'):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=_pool.cache_clear)


_sharing = 0
_lock = Lock()


@contextmanager
def sharing_cores() -> Iterator[None]:
    """Work on one of several frames: threads that do so at the same time share the cores."""
    global _sharing
    with _lock:
        _sharing += 1
    try:
        yield
    finally:
        with _lock:
            _sharing -= 1


def map_halves(kernel: Callable[..., T], rows: int, *arguments: Any) -> tuple[T, T]:
    """Results of kernel(first, after, *arguments) for the upper and the lower half of the rows.

    These halves, whatever the number of threads: sums over them always round alike.
    """
    middle = rows // 2
    lower = Task(kernel, middle, rows, *arguments)
    return kernel(0, middle, *arguments), lower.result()


def run_halves(kernel: Callable[..., None], height: int, *arguments: Any) -> None:
    """Run kernel(rows, *arguments) on both halves of an image at once, then where they meet.

    Two rows in the middle are left to the end, so that neither half sees the other change.
    """
    middle = height // 2
    lower = Task(kernel, (min(middle + 1, height), height), *arguments)
    kernel((0, max(middle - 1, 0)), *arguments)
    lower.result()
    kernel((max(middle - _SEAM, 0), min(middle + _SEAM, height)), *arguments)
