"""A process that finds or compiles kernels: pickled requests in, pickled answers out.

Its requests are ('discover', arguments of `rehearse`), answered by Kernels, and Kernels. Each is
answered by None when it is done. It ends with its input, so with its parent.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
from numba.core.dispatcher import Dispatcher
from numba.core.lowering import BaseLower

from rangeseg_ros.compilation.discovery import Kernel, discover
from rangeseg_ros.compilation.rehearsal import rehearse


def main() -> None:
    """Answer requests until there are no more."""
    # What anything prints must not come between the answers.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), 'wb')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def answer(value: Any) -> None:
        try:
            pickle.dump(value, answers)
            answers.flush()
        except BrokenPipeError:
            os._exit(0)  # the parent has ended

    cv2.setNumThreads(1)
    _share_work()
    _compile_for_python_only()
    while True:
        try:
            request = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        if isinstance(request, Kernel):
            _compile(request)
        else:
            _, arguments = request
            discover(partial(rehearse, *arguments), answer)
        answer(None)


def _compile(kernel: Kernel) -> None:
    dispatcher = getattr(import_module(kernel.module), kernel.name)
    # Of those that were called interpreted here.
    dispatcher = getattr(dispatcher, '_kernel', dispatcher)
    dispatcher.compile(pickle.loads(kernel.signature))


def _compile_for_python_only() -> None:
    """Make no entry for C, which numba compiles of every kernel as well: a tenth of the work."""
    lowering: Any = BaseLower
    lowering.create_cfunc_wrapper = lambda self: None


def _share_work() -> None:
    """Have no two processes compile the same at once: the second waits and loads the result.

    They may belong to different nodes. Locks are per kernel, as numba adds to the index of a
    kernel without one, and form no circle, as kernels do not call each other in one.
    """
    try:
        import fcntl
    except ImportError:  # not on Windows
        return
    kind: Any = Dispatcher
    compile_alone = kind.compile
    held: set[Path] = set()

    @contextmanager
    def locked(path: Path) -> Iterator[None]:
        if path in held:
            yield
            return
        with path.open('w') as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            held.add(path)
            try:
                yield
            finally:
                held.remove(path)

    def compile_locked(self: Any, signature: Any) -> Any:
        cache = getattr(self._cache, '_cache_file', None)
        if cache is None:
            return compile_alone(self, signature)
        with locked(Path(cache._index_path).with_suffix('.lock')):
            return compile_alone(self, signature)

    kind.compile = compile_locked


if __name__ == '__main__':
    main()
