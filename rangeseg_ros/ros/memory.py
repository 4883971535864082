"""Limits on the memory that glibc's malloc keeps after it was freed."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable

# M_ARENA_MAX of glibc's malloc.h.
_ARENA_MAX = -8


def use_one_arena() -> None:
    """Have all threads that are started from now on take memory from one arena.

    By itself glibc gives every thread one of its own, of which it keeps up to 60 MB at the end,
    whatever is trimmed.
    """
    if limit := _from_libc('mallopt'):
        limit(_ARENA_MAX, 1)


def give_back_memory() -> None:
    """Have malloc give all freed memory back to the system, after frames that were larger."""
    if trim := _from_libc('malloc_trim'):
        trim(0)


def _from_libc(name: str) -> Callable[..., int] | None:
    """A function that is glibc's own; None where there is another library."""
    # None is the program itself with what it is linked to.
    return getattr(ctypes.CDLL(None), name, None) if os.name == 'posix' else None
