"""Ctrl-C and other ends that get through: compiled code may lose the exception, or wrap it."""

from __future__ import annotations

import atexit
import os
import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import NoReturn

_received = 0


def watch() -> None:
    """Remember interrupts, which raise KeyboardInterrupt as usual, and SIGTERM and SIGHUP.

    These end the command as errors do: what was begun is put away. A signal that is ignored stays
    ignored.
    """
    global _received
    _received = 0
    silence_losses()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _on_signal)


def silence_losses() -> None:
    """Have nothing printed of what a signal raises where it is lost, as in callbacks of LLVM."""
    sys.unraisablehook = _on_loss


def exit_code() -> int:
    """Of the signal that there was; 0 when there was none."""
    return 128 + _received if _received else 0


def end() -> NoReturn:
    """End the process for the signal that there was, once all that was begun is put away.

    Python itself would wait for all threads, and for ever for one that waits for a lock: what a
    signal raises in `Condition.__enter__` leaves its lock taken, those of thread pools too.
    """
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # nobody reads it, or it is closed
            stream.flush()
    os._exit(exit_code())


def check() -> None:
    """Raise again what was raised for a signal and was lost."""
    if _received == signal.SIGINT:
        raise KeyboardInterrupt
    if _received:
        raise SystemExit(exit_code())


def _on_signal(number: int, stack: FrameType | None) -> None:
    global _received
    _received = number
    check()


def loses(stack: FrameType | None) -> bool:
    """Whether what is raised there would be printed: while a loss is silenced."""
    return bool(stack and stack.f_code is _on_loss.__code__)


def _on_loss(lost: sys.UnraisableHookArgs) -> None:
    if not isinstance(lost.exc_value, (KeyboardInterrupt, SystemExit)):
        sys.__unraisablehook__(lost)
