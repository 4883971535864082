"""Where compiled kernels are kept: what is read from there is executed.

numba keeps them beside the sources, or in the user's cache folder, and refuses to work where it
may write to neither: in containers with a read-only root, for users without a home. And it takes
whatever it finds there, also where others have put it.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import stat
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from rangeseg_ros.core.runtime.outdated import drop_outdated, stamps

PACKAGE = Path(__file__).parents[2]


class CacheWarning(UserWarning):
    """Compiled kernels cannot be kept, or not where they were to be."""


def choose_cache() -> None:
    """Give numba a folder for compiled kernels, before the first kernel is defined.

    The first that can be written to, and not by other users: `NUMBA_CACHE_DIR`, the package
    (whoever can write there can change the sources), the user's cache folder, `ROS_HOME`, a folder
    of the user's own in the temporary directory or in shared memory, one there for this process
    alone. Kernels that were compiled into a package which is read-only now are copied there.

    Warns
    -----
    CacheWarning
        `NUMBA_CACHE_DIR` is not such a folder, or what is compiled is lost with the process.

    Raises
    ------
    OSError
        No folder can be written to.
    """
    given = os.environ.pop('NUMBA_CACHE_DIR', None)
    if given:
        if folder := _own_folder(Path(given)):
            _keep_in(folder)
            return
        _warn(
            f'NUMBA_CACHE_DIR: {given} is not used: it cannot be written to, or others can write '
            'to it, and what is in it would be executed'
        )
    if writable(PACKAGE / 'core' / '__pycache__'):
        drop_outdated(PACKAGE)
        _tell_numba('')
        return
    for root in _roots():
        if folder := _own_folder(root):
            _keep_in(folder)
            _copy_compiled(folder)
            return
    for temporary in _temporary_folders():
        with suppress(OSError):
            folder = Path(tempfile.mkdtemp(prefix='rangeseg_ros-', dir=temporary))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            _warn(
                'compiled kernels cannot be kept, so that every start compiles them: no folder '
                'can be written to by this user alone; set NUMBA_CACHE_DIR to one that can'
            )
            _keep_in(folder)
            _copy_compiled(folder)
            return
    raise OSError('no folder for compiled kernels can be written to; set NUMBA_CACHE_DIR to one')


def writable(folder: Path) -> bool:
    """Whether files can be made in the folder, which is made where it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _own_folder(root: Path) -> Path | None:
    """Folder within `root` for this state of the sources; None where it is not ours alone."""
    state = hashlib.sha256(repr(stamps(PACKAGE)).encode()).hexdigest()
    name = f'rangeseg_ros-{state[:16]}'
    # Other than a process that was told of it by the one that started it.
    folder = root if root.name == name else root / name
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if _private(folder) and writable(folder) else None


def _private(folder: Path) -> bool:
    """Whether nobody but this user and root can write to the folder, or put another in its place.

    A group with the number of its user is taken for that user's own, as Linux gives it.
    """
    if not hasattr(os, 'getuid'):
        return True
    try:
        real = folder.resolve(strict=True)
        chain = [path.stat() for path in (real, *real.parents)]
    except (OSError, RuntimeError):  # the latter of links in a circle
        return False
    if folder.is_symlink() or not folder.is_dir() or chain[0].st_uid != os.getuid():
        return False
    for found in chain:
        others = stat.S_IWOTH if found.st_gid == found.st_uid else stat.S_IWOTH | stat.S_IWGRP
        # Where the sticky bit is set, as for /tmp, nobody can replace what others have in there.
        sticky = found is not chain[0] and found.st_mode & stat.S_ISVTX
        if found.st_uid not in (0, os.getuid()) or (found.st_mode & others and not sticky):
            return False
    return True


def _keep_in(folder: Path) -> None:
    """Have numba, here and in processes started from here, keep kernels in `folder`."""
    os.environ['NUMBA_CACHE_DIR'] = os.fspath(folder)
    _tell_numba(os.fspath(folder))


def _tell_numba(folder: str) -> None:
    """Where kernels are kept, if numba has read its environment already; '' for the package."""
    if 'numba' in sys.modules:
        sys.modules['numba'].config.CACHE_DIR = folder


def _warn(text: str) -> None:
    warnings.warn(text, CacheWarning, stacklevel=3)


def _roots() -> Iterator[Path]:
    cache = os.environ.get('XDG_CACHE_HOME')
    home = os.environ.get('HOME')
    if cache or home:
        yield (Path(cache) if cache else Path(home or '', '.cache')) / 'rangeseg_ros'
    if ros_home := os.environ.get('ROS_HOME'):
        yield Path(ros_home) / 'rangeseg_ros'
    for temporary in _temporary_folders():
        # Not in a folder that somebody else has made there.
        own = temporary / f'rangeseg_ros-{os.getuid()}'
        with suppress(OSError):
            own.mkdir(mode=0o700, exist_ok=True)
            if _private(own):
                yield own


def _temporary_folders() -> Iterator[Path]:
    if not hasattr(os, 'getuid'):
        return
    with suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir())
    # Memory: containers with a read-only root have it, too, and it lasts as long as they do.
    yield Path('/dev/shm')


def _copy_compiled(folder: Path) -> None:
    """Copy kernels compiled into the package to where numba looks for them in `folder`."""
    from numba.core.caching import _CacheLocator

    for compiled in PACKAGE.rglob('__pycache__/*.nb[ic]'):
        source = compiled.parents[1] / '__init__.py'
        target = folder / _CacheLocator.get_suitable_cache_subpath(source) / compiled.name
        if target.exists():
            continue
        target.parent.mkdir(exist_ok=True)
        part = target.with_name(f'{target.name}.{os.getpid()}')
        shutil.copy2(compiled, part)
        os.replace(part, target)
