"""Files that are whole or not there, what may be replaced, and the order of names."""

from __future__ import annotations

import atexit
import errno
import fcntl
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from tempfile import gettempdir
from typing import TypeVar

T = TypeVar('T')

# Temporary folders of this process. A signal may come while one is made or removed, where no
# `finally` helps; what is still there when the process exits goes then.
_unfinished: set[Path] = set()
# A full disk, quota or largest file: Python does not say of which file.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class NotReplacedError(OSError):
    """Something that is there already, and is not to be replaced."""

    def __init__(self, path: Path, reason: str = 'exists already, not overwritten') -> None:
        super().__init__(f'{path}: {reason}')


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary place for a file or folder of the name of `path`.

    On success it is moved to `path`, or to what that links to; after an exception or an
    interruption nothing is left. A file keeps its mode; other names (hard links) of one that is
    replaced stay with what it was.

    Raises
    ------
    NotReplacedError
        `path` is a device, a pipe or the like.
    OSError
        It cannot be written; of a full disk, too, the error names the file.
    """
    path = resolved(path) if path.is_symlink() else path
    check_regular(path)
    folder = path.with_name(f'.{os.getpid()}.{path.name}')
    with temporary_folder(folder):
        try:
            yield folder / path.name
            if path.is_file():
                shutil.copymode(path, folder / path.name)
            os.replace(folder / path.name, path)
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


@contextmanager
def temporary_folder(folder: Path) -> Iterator[None]:
    """Make a folder that is gone in the end; while it is there, `abandoned` knows that it is used.

    Raises
    ------
    FileExistsError
        Another process uses a folder of this name.
    """
    if abandoned(folder):
        shutil.rmtree(folder, ignore_errors=True)
    _unfinished.add(folder)
    try:
        folder.mkdir(mode=0o700, parents=True)
    except OSError:
        _unfinished.discard(folder)
        raise
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(lock)
        shutil.rmtree(folder, ignore_errors=True)
        _unfinished.discard(folder)


@atexit.register
def _remove_unfinished() -> None:
    for folder in list(_unfinished):
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def scratch_folder(name: str) -> Iterator[Path]:
    """Give a folder in the temporary directory for what is needed until the end of the block.

    Those of this `name` that killed processes have left are removed.
    """
    path = Path(gettempdir(), name)
    clear_abandoned(path)
    folder = path.with_name(f'.{os.getpid()}.{name}')
    with temporary_folder(folder):
        yield folder


def abandoned(folder: Path) -> bool:
    """Whether this is a `temporary_folder` whose process was killed."""
    try:
        if not stat.S_ISDIR(folder.lstat().st_mode):
            return False
        lock = os.open(folder, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(lock)
    return True


def clear_abandoned(path: Path) -> None:
    """Remove the temporary folders that killed processes have left of `replacing(path)`."""
    pattern = re.compile(rf'\.\d+\.{re.escape(path.name)}')
    if path.parent.is_dir():
        for folder in path.parent.iterdir():
            if pattern.fullmatch(folder.name) and abandoned(folder):
                shutil.rmtree(folder, ignore_errors=True)


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
