"""Which kernels a run needs, and for which types, without compiling any.

Every kernel is a Python function as well. A run in which they are called as such, on small
frames, takes a second and shows what has to be compiled.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.core.dispatcher import Dispatcher

PACKAGE = 'rangeseg_ros'


class Kernel(NamedTuple):
    """A kernel to be compiled.

    Attributes
    ----------
    module, name : str
        Where its dispatcher is.
    signature : bytes
        Pickled tuple of the types of its arguments.
    size : int
        Bytes of Python bytecode of it and of all it calls: what compiling it costs, roughly.
    """

    module: str
    name: str
    signature: bytes
    size: int


def discover(run: Callable[[], Any], found: Callable[[Kernel], None]) -> None:
    """Tell `found` of every kernel that `run` calls from Python, once for each signature.

    Afterwards the kernels of this process stay interpreted: for a process of its own.
    """
    interpreter = _Interpreter(found)
    for name, module in list(sys.modules.items()):
        if name.startswith(PACKAGE):
            for key, value in list(vars(module).items()):
                if isinstance(value, Dispatcher):
                    setattr(module, key, _Interpreted(value, interpreter))
    with np.errstate(all='ignore'):
        run()


class _Interpreter:
    """Runs kernels as Python functions and notes what was asked for."""

    def __init__(self, found: Callable[[Kernel], None]) -> None:
        self._found = found
        self._known: set[tuple[Any, ...]] = set()
        self._inside = False

    def call(self, kernel: Dispatcher, arguments: tuple[Any, ...]) -> Any:
        # What kernels call is compiled with them; the types here would be those of Python.
        if self._inside:
            return kernel.py_func(*arguments)
        signature = tuple(kernel.typeof_pyval(argument) for argument in arguments)
        name = kernel.py_func.__module__, kernel.py_func.__qualname__
        if (*name, signature) not in self._known:
            self._known.add((*name, signature))
            self._found(Kernel(*name, pickle.dumps(signature), _size(kernel, set())))
        self._inside = True
        try:
            return _as_compiled(kernel.py_func(*arguments))
        finally:
            self._inside = False


class _Interpreted:
    """Takes the place of a kernel; for kernels that are compiled it still is one."""

    def __init__(self, kernel: Dispatcher, interpreter: _Interpreter) -> None:
        self._kernel = kernel
        self._interpreter = interpreter
        self._numba_type_ = kernel._numba_type_

    def __call__(self, *arguments: Any) -> Any:
        return self._interpreter.call(self._kernel, arguments)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)


def _as_compiled(value: Any) -> Any:
    """A result as compiled code gives it: Python's numbers in place of NumPy's."""
    if isinstance(value, np.generic) and value.dtype.kind in 'biuf':
        return value.item()
    if type(value) is tuple:
        return tuple(map(_as_compiled, value))
    return value


def _size(kernel: Any, seen: set[int]) -> int:
    if id(kernel) in seen:
        return 0
    seen.add(id(kernel))
    code, names = kernel.py_func.__code__, kernel.py_func.__globals__
    called = [names[name] for name in code.co_names if name in names]
    return len(code.co_code) + sum(
        _size(getattr(other, '_kernel', other), seen)
        for other in called
        if isinstance(other, (Dispatcher, _Interpreted))
    )
