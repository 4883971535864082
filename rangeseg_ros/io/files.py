"""Files that are whole or not there, what may be replaced, and the order of names."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

TEMPORARY = '.rangeseg-'
"""How the names of temporary folders begin."""

# A full disk, quota or largest file: Python does not say of which file.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class FileError(ValueError):
    """A file that cannot be read, or is not of the kind asked for."""


class NotReplacedError(OSError):
    """Something that is there already, and is not to be replaced."""

    def __init__(self, path: Path, reason: str = 'exists already, not overwritten') -> None:
        super().__init__(f'{path}: {reason}')


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary place for a file or folder of the name of `path`.

    On success it is moved to `path`, or to what that links to; after an exception nothing is
    left. A file keeps its mode; other names (hard links) of one that is replaced stay with what it
    was. FileError: `path` is a device, a pipe or the like. OSError: it cannot be written; of a
    full disk, too, the error names the file.
    """
    path = resolved(path) if path.is_symlink() else path
    check_regular(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=TEMPORARY, dir=path.parent) as folder:
        partial = Path(folder, path.name)
        try:
            yield partial
            if path.is_file():
                shutil.copymode(path, partial)
            os.replace(partial, path)
        except OSError as error:
            if error.errno in _NO_ROOM:
                error.filename = str(path)
            raise


def resolved(path: Path) -> Path:
    """What a path leads to; OSError where its links lead in a circle."""
    with suppress(FileNotFoundError, NotADirectoryError):
        path.stat()
    return path.resolve()


def check_regular(path: Path) -> None:
    """Raise FileError for devices, pipes and the like."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise FileError(f'{path}: not a regular file')


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """Content of a regular file of at most so many bytes; FileError says in one line what it is.

    Pipes and devices are refused, as they may not end.
    """
    try:
        check_regular(path)
        if most is not None and path.stat().st_size > most:
            raise FileError(f'{path}: too large, or no such file as is expected here')
        return path.read_bytes()
    except OSError as error:
        raise FileError(f'{path}: {error.strerror}') from None


def natural_order(path: Path) -> list[str | int]:
    """Sort key that puts frame_2 before frame_10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', path.name)]
