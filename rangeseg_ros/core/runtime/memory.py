"""Memory that one frame frees and the next one needs again."""

from __future__ import annotations

import ctypes
import os

import numpy as np

# What glibc's malloc learns from at most.
_BLOCK = 30 << 20


def keep_freed_memory() -> None:
    """Have malloc keep freed memory for the next frame.

    By itself glibc gives freed memory back to the system where there is more than twice the
    largest block ever given back, and fresh pages cost a third of a frame's time. So it is
    given back a large one. With another malloc nothing happens.
    """
    np.empty(_BLOCK, np.uint8)


def give_back_memory() -> None:
    """Have malloc give all freed memory back to the system, after frames that were larger."""
    # glibc's; None is the program itself with what it is linked to.
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None) if os.name == 'posix' else None
    if trim:
        trim(0)
