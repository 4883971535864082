"""Compiled kernels: compiled ahead where a frame needs them.

numba would compile kernels when they are first needed, one after the other, in silence. What
compiles all of them ahead, in several processes, is above the core: it says here what is to be
called.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from numba.core import event
from numba.np import linalg

T = TypeVar('T')

_PACKAGE = f'{Path(__file__).parents[2].name}.'
_ahead: Callable[..., None] | None = None
_inside = ContextVar('inside', default=False)

# At the first kernel, numba would import SciPy's linear algebra: 14 MB that no kernel here calls.
# Restored afterwards, so that it is imported for kernels that do.
_ensure_blas, linalg.ensure_blas = linalg.ensure_blas, lambda: None
import_module('numba.np.arraymath')
linalg.ensure_blas = _ensure_blas


class NotCompiledError(Exception):
    """A kernel is not in the cache."""


def compile_ahead_by(ahead: Callable[..., None]) -> None:
    """Have `ahead` called where a frame needs kernels that are not compiled."""
    global _ahead
    _ahead = ahead


def with_kernels(run: Callable[[], T], *needed: Any) -> T:
    """Result of run(), after what `compile_ahead_by` was given has compiled kernels it lacks.

    `compiled_by` does that itself for all that it runs.
    """
    if _ahead is None or _inside.get():
        return run()
    return compiled_by(partial(_ahead, *needed), run)


def compiled_by(ahead: Callable[[], None], run: Callable[[], T]) -> T:
    """Result of run(), after ahead() where kernels are not compiled."""
    inside = copy_context()
    inside.run(_inside.set, True)
    try:
        with nothing_compiled():
            return inside.run(run)
    except NotCompiledError:
        ahead()
    return inside.run(run)


@contextmanager
def nothing_compiled() -> Iterator[None]:
    """Raise `NotCompiledError` where a kernel of the package would be compiled."""
    with event.install_listener('numba:compile', _Refusal()):
        yield


class _Refusal(event.Listener):
    def on_start(self, event: Any) -> None:
        if event.data['dispatcher'].py_func.__module__.startswith(_PACKAGE):
            raise NotCompiledError(event.data['dispatcher'], event.data['args'])

    def on_end(self, event: Any) -> None: ...
