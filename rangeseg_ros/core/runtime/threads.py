"""Compiled kernels on several threads: they release the interpreter while they run.

Threads of our own and none of numba's: those do not survive a fork, and the default ones may not
be entered from two threads. There are as many as OpenCV uses, so that `cv2.setNumThreads` sets
both.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from threading import Lock
from typing import Any, TypeVar

import cv2

T = TypeVar('T')

# More would wait for the memory.
_MAX_THREADS = 4
# Rows that are worth the handing over.
_ROWS = 16
# Rows on either side of the middle of the image that are looked at again.
_SEAM = 8


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_MAX_THREADS, 'rangeseg')


if hasattr(os, 'register_at_fork'):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=_pool.cache_clear)


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


def run_rows(kernel: Callable[..., None], rows: int, *arguments: Any) -> None:
    """Run kernel(first, after, *arguments) on strips of the rows at the same time.

    What one strip writes no other may touch: then the result is the same for any number of
    threads.
    """
    count = max(min(_cores(), _MAX_THREADS, rows // _ROWS), 1)
    bounds = [rows * part // count for part in range(count + 1)]
    others = [
        _pool().submit(kernel, first, after, *arguments) for first, after in pairwise(bounds[1:])
    ]
    kernel(0, bounds[1], *arguments)
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


def submit(task: Callable[..., T], *arguments: Any) -> Future[T]:
    """Start a task that has no subtasks here, beside what the caller does until `result()`."""
    if _cores() > 1:
        return _pool().submit(task, *arguments)
    future: Future[T] = Future()
    future.set_result(task(*arguments))
    return future
