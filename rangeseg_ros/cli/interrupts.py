"""Ctrl-C that gets through: compiled code may lose the exception that it raises, or wrap it."""

from __future__ import annotations

import signal
from types import FrameType

_received = False


def watch() -> None:
    """Remember interrupts; they raise KeyboardInterrupt as ever. Who ignores them still does."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _on_interrupt)


def received() -> bool:
    """Whether there was an interrupt."""
    return _received


def check() -> None:
    """Raise KeyboardInterrupt after an interrupt whose exception was lost."""
    if _received:
        raise KeyboardInterrupt


def _on_interrupt(number: int, stack: FrameType | None) -> None:
    global _received
    _received = True
    raise KeyboardInterrupt
