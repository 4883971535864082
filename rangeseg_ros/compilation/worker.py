"""A process that finds out which kernels frames need, and compiles them by processes of its own.

It reads the pickled arguments of `rehearse`, and writes a line with the numbers of kernels that
are done and of all after each. It ends with whoever reads these.

Every kernel is a Python function as well. A run in which they are called as such, on small
frames, takes seconds and shows what has to be compiled.
"""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numba.core.dispatcher import Dispatcher

from rangeseg_ros import kernel_cache as cache
from rangeseg_ros.compilation.preparation import rehearse

_MOST_PROCESSES = 4


class Kernel(NamedTuple):
    """A kernel to be compiled: where its dispatcher is, and the types of its arguments."""

    module: str
    name: str
    signature: tuple[Any, ...]


def main() -> None:
    """Compile all kernels that are not in the cache."""
    # What anything prints must not come between the answers.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), 'w')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    rehearsed = partial(rehearse, *pickle.load(sys.stdin.buffer))
    folder = os.environ.get('NUMBA_CACHE_DIR') or cache.PACKAGE / 'core' / '__pycache__'
    # Those of a fork have imported all there is, and share its memory.
    context = get_context('fork')
    with Path(folder, 'compiling.lock').open('w') as file:
        # The second process that compiles for the same folder finds all done.
        fcntl.flock(file, fcntl.LOCK_EX)
        with context.Pool(1) as pool:
            kernels = pool.apply(discover, (rehearsed,))
        processes = min(_MOST_PROCESSES, len(os.sched_getaffinity(0)))
        with context.Pool(processes, gc.disable) as pool:
            for done, _ in enumerate(pool.imap_unordered(_compile, kernels), 1):
                print(done, len(kernels), file=answers, flush=True)


def _compile(kernel: Kernel) -> None:
    getattr(import_module(kernel.module), kernel.name).compile(kernel.signature)


def discover(run: Callable[[], Any]) -> list[Kernel]:
    """Kernels that `run` calls from Python, once for each signature, largest first.

    Afterwards the kernels of this process stay interpreted: for a process of its own.
    """
    cv2.setNumThreads(1)  # what a kernel calls is told from the thread that it is called in
    found: dict[Kernel, int] = {}
    for name, module in list(sys.modules.items()):
        if name.startswith(f'{cache.PACKAGE.name}.'):
            for key, value in list(vars(module).items()):
                if isinstance(value, Dispatcher):
                    setattr(module, key, _Interpreted(value, found))
    with np.errstate(all='ignore'):
        run()
    return sorted(found, key=lambda kernel: -found[kernel])


class _Interpreted:
    """Takes the place of a kernel: calls it as a Python function and notes for which types."""

    _inside = False

    def __init__(self, kernel: Dispatcher, found: dict[Kernel, int]) -> None:
        self._kernel = kernel
        self._found = found

    def __call__(self, *arguments: Any) -> Any:
        function = self._kernel.py_func
        # What kernels call is compiled with them; the types here would be those of Python.
        if _Interpreted._inside:
            return function(*arguments)
        signature = tuple(self._kernel.typeof_pyval(argument) for argument in arguments)
        kernel = Kernel(function.__module__, function.__qualname__, signature)
        if kernel not in self._found:
            self._found[kernel] = _size(self, set())
        _Interpreted._inside = True
        try:
            return _as_compiled(function(*arguments))
        finally:
            _Interpreted._inside = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)


def _as_compiled(value: Any) -> Any:
    """A result as compiled code gives it: Python's numbers in place of NumPy's."""
    if isinstance(value, np.generic) and value.dtype.kind in 'biuf':
        return value.item()
    return tuple(map(_as_compiled, value)) if type(value) is tuple else value


def _size(kernel: _Interpreted, counted: set[Any]) -> int:
    """Bytes of bytecode of a kernel and of all it calls: what compiling it costs, roughly."""
    if kernel.py_func in counted:
        return 0
    counted.add(kernel.py_func)
    code, names = kernel.py_func.__code__, kernel.py_func.__globals__
    called = [names[name] for name in code.co_names if isinstance(names.get(name), _Interpreted)]
    return len(code.co_code) + sum(_size(other, counted) for other in called)


if __name__ == '__main__':
    try:
        main()
    except BrokenPipeError:  # nobody reads any more
        os._exit(1)
