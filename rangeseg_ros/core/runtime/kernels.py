"""Compiled kernels: compiled ahead where a frame needs them, and loaded without their bitcode.

numba would compile kernels when they are first needed, one after the other, in silence. What
compiles all of them ahead, in several processes, is above the core: it says here what is to be
called.

numba keeps LLVM's bitcode with each compiled kernel, for kernels that call it, and parses it at
once: a third of the time that the first frame takes, and 30 MB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

from llvmlite import binding
from numba.core import event
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen

T = TypeVar('T')

_PACKAGE = f'{Path(__file__).parents[2].name}.'
_ahead: Callable[..., None] | None = None
_inside = ContextVar('inside', default=False)


class NotCompiledError(Exception):
    """A kernel is not in the cache."""


def compile_ahead_by(ahead: Callable[..., None]) -> None:
    """Have `ahead` called where a frame needs kernels that are not compiled."""
    global _ahead
    _ahead = ahead


def with_kernels(run: Callable[[], T], *needed: Any) -> T:
    """Result of run(); where kernels are not compiled, after ahead(*needed) has compiled them."""
    if _ahead is None or _inside.get():
        return run()
    try:
        with nothing_compiled():
            return run()
    except NotCompiledError:
        _ahead(*needed)
    return run()


@contextmanager
def not_ahead() -> Iterator[None]:
    """Compile nothing ahead in this thread: for what does that, and runs frames itself."""
    token = _inside.set(True)
    try:
        yield
    finally:
        _inside.reset(token)


@contextmanager
def nothing_compiled() -> Iterator[None]:
    """Raise `NotCompiledError` where a kernel of the package would be compiled."""

    class Refuse(event.Listener):
        def on_start(self, event: Any) -> None:
            if event.data['dispatcher'].py_func.__module__.startswith(_PACKAGE):
                raise NotCompiledError(event.data['dispatcher'], event.data['args'])

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener('numba:compile', Refuse()):
        yield


class LazyLibrary(JITCodeLibrary):
    """Compiled code whose bitcode is parsed when a kernel is compiled that calls it."""

    _machine_code = _bitcode = b''

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> LazyLibrary:
        name, _, (machine_code, bitcode) = state
        library: LazyLibrary = codegen.create_library(name)
        library._machine_code, library._bitcode = machine_code, bitcode
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._finalize_final_module()
        return library

    def _get_module_for_linking(self) -> Any:
        if self._bitcode and self._shared_module is None:
            self._shared_module = binding.parse_bitcode(self._bitcode)
        return super()._get_module_for_linking()

    def get_pointer_to_function(self, name: str) -> int:
        # numba looks it up among the symbols of the bitcode; all formats of objects end names so.
        if name.encode() + b'\0' in self._machine_code:
            self._ensure_finalized()
            return int(self._codegen._engine.get_function_address(name))
        return int(super().get_pointer_to_function(name))


def load_lazily() -> None:
    """Have numba load compiled kernels so from now on."""
    JITCPUCodegen._library_class = LazyLibrary
