"""Files that are whole or not there, what may be replaced, and the order of names."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

T = TypeVar('T')

TEMPORARY = '.rangeseg-'
"""How the names of temporary folders begin."""

# A full disk, quota or largest file: Python does not say of which file.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class NotReplacedError(OSError):
    """Something that is there already, and is not to be replaced."""

    def __init__(self, path: Path, reason: str = 'exists already, not overwritten') -> None:
        super().__init__(f'{path}: {reason}')


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary place for a file or folder of the name of `path`.

    On success it is moved to `path`, or to what that links to; after an exception nothing is
    left. A file keeps its mode; other names (hard links) of one that is replaced stay with what it
    was.

    Raises
    ------
    NotReplacedError
        `path` is a device, a pipe or the like.
    OSError
        It cannot be written; of a full disk, too, the error names the file.
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
    """Raise NotReplacedError for devices, pipes and the like."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise NotReplacedError(path, 'not a regular file')


def cached_while_unchanged(read: Callable[[Path], T]) -> Callable[[Path], T]:
    """Make a function that reads a file keep its results as long as the file does not change."""

    @lru_cache(maxsize=4)
    def kept(path: Path, time: int, size: int) -> T:
        return read(path)

    def load(path: Path) -> T:
        try:
            state = path.stat()
        except OSError:
            return read(path)  # which says what is wrong
        return kept(path, state.st_mtime_ns, state.st_size)

    return load


def natural_order(path: Path) -> list[str | int]:
    """Sort key that puts frame_2 before frame_10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', path.name)]
