"""Which kernels a run needs, and for which types, without compiling any.

Every kernel is a Python function as well. A run in which they are called as such, on small
frames, takes seconds and shows what has to be compiled.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numba.core.dispatcher import Dispatcher

PACKAGE = 'rangeseg_ros'


class Kernel(NamedTuple):
    """A kernel to be compiled.

    Attributes
    ----------
    module, name : str
        Where its dispatcher is.
    signature : tuple
        Types of its arguments.
    size : int
        Bytes of Python bytecode of it and of all it calls: what compiling it costs, roughly.
    """

    module: str
    name: str
    signature: tuple[Any, ...]
    size: int


def discover(run: Callable[[], Any]) -> list[Kernel]:
    """Kernels that `run` calls from Python, once for each signature, largest first.

    Afterwards the kernels of this process stay interpreted: for a process of its own.
    """
    cv2.setNumThreads(1)  # what a kernel calls is told from the thread that it is called in
    found: dict[tuple[Any, ...], Kernel] = {}
    for name, module in list(sys.modules.items()):
        if name.startswith(PACKAGE):
            for key, value in list(vars(module).items()):
                if isinstance(value, Dispatcher):
                    setattr(module, key, _Interpreted(value, found))
    with np.errstate(all='ignore'):
        run()
    return sorted(found.values(), key=lambda kernel: -kernel.size)


class _Interpreted:
    """Takes the place of a kernel: calls it as a Python function and notes for which types."""

    _inside = False

    def __init__(self, kernel: Dispatcher, found: dict[tuple[Any, ...], Kernel]) -> None:
        self._kernel = kernel
        self._found = found

    def __call__(self, *arguments: Any) -> Any:
        kernel = self._kernel
        # What kernels call is compiled with them; the types here would be those of Python.
        if _Interpreted._inside:
            return kernel.py_func(*arguments)
        signature = tuple(kernel.typeof_pyval(argument) for argument in arguments)
        name = kernel.py_func.__module__, kernel.py_func.__qualname__
        if (*name, signature) not in self._found:
            self._found[(*name, signature)] = Kernel(*name, signature, _size(self, set()))
        _Interpreted._inside = True
        try:
            return _as_compiled(kernel.py_func(*arguments))
        finally:
            _Interpreted._inside = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)


def _as_compiled(value: Any) -> Any:
    """A result as compiled code gives it: Python's numbers in place of NumPy's."""
    if isinstance(value, np.generic) and value.dtype.kind in 'biuf':
        return value.item()
    if type(value) is tuple:
        return tuple(map(_as_compiled, value))
    return value


def _size(kernel: _Interpreted, counted: set[Any]) -> int:
    if kernel.py_func in counted:
        return 0
    counted.add(kernel.py_func)
    code, names = kernel.py_func.__code__, kernel.py_func.__globals__
    called = [names[name] for name in code.co_names if isinstance(names.get(name), _Interpreted)]
    return len(code.co_code) + sum(_size(other, counted) for other in called)
