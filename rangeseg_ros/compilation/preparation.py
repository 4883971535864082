"""Everything that a configuration needs compiled, by several processes, and loaded."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import astuple, replace
from threading import Condition, Thread
from typing import Any

from numba.core import event

from rangeseg_ros.compilation.discovery import PACKAGE, Kernel
from rangeseg_ros.compilation.rehearsal import KINDS, rehearse
from rangeseg_ros.core.config import Config
from rangeseg_ros.messages.outputs import OUTPUTS

MOST_WORKERS = 4
"""Processes that compile, at most: each takes 250 MB, and the largest kernel an eighth of all."""

Report = Callable[[str], None]


def needs(config: Config) -> tuple[Any, ...]:
    """What of `config` decides which kernels run: choices and switches, not how large values are.

    Of numbers whether they are zero, as that often switches something off; a smallest region of 0
    pixels only follows the size of the image.
    """
    values = astuple(replace(config, min_pixels=1))
    return tuple(v if isinstance(v, (str, bool)) else v == 0 for v in values)


def prepare(
    config: Config,
    kinds: tuple[str, ...] = KINDS,
    report: Report = print,
    outputs: Collection[str] = tuple(OUTPUTS),
) -> None:
    """Compile all kernels that `config` needs for frames of `kinds`, and load them.

    Where they are compiled already, this takes as long as to load them.

    Parameters
    ----------
    config : Config
    kinds : tuple of str
        Of `rehearsal.KINDS`.
    report : callable
        Gets the progress, 'compiling kernels, 12 of 35'; nothing when nothing is compiled.
    outputs : collection of str
        Of `OUTPUTS`: what is made of the frames.
    """
    try:
        with _nothing_compiled():
            rehearse(config, kinds, outputs)
        return
    except _NotCompiledError:
        pass
    report('compiling kernels')
    Pool(report).compile(config, kinds, outputs)
    rehearse(config, kinds, outputs)


class _NotCompiledError(Exception):
    """A kernel is not in the cache."""


@contextmanager
def _nothing_compiled() -> Iterator[None]:
    """Raise `_NotCompiledError` where a kernel of ours would be compiled."""

    class Refuse(event.Listener):
        def on_start(self, event: Any) -> None:
            if event.data['dispatcher'].py_func.__module__.startswith(PACKAGE):
                raise _NotCompiledError(event.data['dispatcher'], event.data['args'])

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener('numba:compile', Refuse()):
        yield


class Pool:
    """Processes that compile what one of them finds.

    Parameters
    ----------
    report : callable
        Gets the progress.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._changed = Condition()
        self._waiting: list[Kernel] = []
        self._found = self._done = 0
        self._finding = True

    def compile(self, *rehearsed: Any) -> None:
        """Fill the cache with what `rehearse(*rehearsed)` needs.

        What a process that breaks off leaves is compiled by its user.
        """
        count = max(1, min(MOST_WORKERS, _processors()))
        threads = [
            Thread(target=self._attend, args=(('discover', rehearsed) if k == 0 else None,))
            for k in range(count)
        ]
        for thread in threads:
            thread.daemon = True
            thread.start()
        for thread in threads:
            thread.join()

    def _attend(self, discovery: Any) -> None:
        """Give a worker one kernel after the other."""
        # Of a group of its own, so that Ctrl-C is for the parent, with whom its input ends.
        worker = subprocess.Popen(
            [sys.executable, '-m', 'rangeseg_ros.compilation.worker'],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,
        )
        assert worker.stdin and worker.stdout
        try:
            request = discovery or self._next()
            while request:
                pickle.dump(request, worker.stdin)
                worker.stdin.flush()
                while (answer := pickle.load(worker.stdout)) is not None:
                    self._add(answer)
                self._finished(request)
                request = self._next()
        except (EOFError, OSError):
            pass  # its user will meet the kernel itself, and say what is wrong with it
        finally:
            if discovery:
                self._end_of_discovery()
            with suppress(BrokenPipeError):  # what a dead worker did not take
                worker.stdin.close()
            worker.stdout.close()
            worker.wait()

    def _add(self, kernel: Kernel) -> None:
        with self._changed:
            self._waiting.append(kernel)
            self._found += 1
            self._changed.notify()

    def _next(self) -> Kernel | None:
        """The largest kernel that waits, so that none is left for the end; None after the last."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or not self._finding)
            if not self._waiting:
                return None
            kernel = max(self._waiting, key=lambda waiting: waiting.size)
            self._waiting.remove(kernel)
            return kernel

    def _finished(self, request: Any) -> None:
        if not isinstance(request, Kernel):
            self._end_of_discovery()
            return
        with self._changed:
            self._done += 1
            more = 'at least ' if self._finding else ''
            self._report(f'compiling kernels, {self._done} of {more}{self._found}')

    def _end_of_discovery(self) -> None:
        with self._changed:
            self._finding = False
            self._changed.notify_all()


def _processors() -> int:
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
