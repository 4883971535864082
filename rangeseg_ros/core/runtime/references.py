"""Kernels that do not count references to the arrays they look at.

numba counts a reference for every view, every attribute of a named tuple and every argument of an
inlined function, by an atomic instruction each, and drops only those counts that it can prove to
cancel. Where a loop makes them for every pixel or block they are a tenth of its time.
"""

from __future__ import annotations

from typing import Any

UNCOUNTED: dict[str, Any] = {'_nrt': False}
"""For `njit`: of functions that make no array and return none; their caller holds them all."""
