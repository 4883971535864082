"""Errors in one line."""

from __future__ import annotations

from rangeseg_ros.extras import install_command


def one_line(error: BaseException) -> str:
    """What an error says, in one line of printable characters."""
    text = str(error)
    if isinstance(error, MemoryError):
        text = f'not enough memory{": " if text else ""}{text}'
    elif isinstance(error, RecursionError):
        text = 'nested too deeply'
    elif isinstance(error, ModuleNotFoundError):
        text = install_command(error) or f'{text}: is the installation complete?'
    elif isinstance(error, OSError) and error.filename is not None and error.strerror:
        text = f'{error.filename}: {error.strerror}'
    # Names of files and topics may hold anything.
    return ''.join(c if c.isprintable() else repr(c)[1:-1] for c in text)
