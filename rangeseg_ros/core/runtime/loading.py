"""Compiled kernels are loaded without what only the compilation of others needs of them.

numba keeps LLVM's bitcode with each compiled kernel, for kernels that call it, and parses it at
once: half of the time that loading takes, and 40 MB of the kernels of a frame.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen


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
