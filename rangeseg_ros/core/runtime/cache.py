"""Where compiled kernels are kept when the package itself may not be written to.

numba keeps them beside the sources, or in the user's cache folder, and refuses to work where it
may write to neither: in containers with a read-only root, for users without a home.
"""

from __future__ import annotations

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
from typing import Any

from rangeseg_ros.core.runtime.outdated import drop_outdated, stamps

PACKAGE = Path(__file__).parents[2]


class CacheWarning(UserWarning):
    """Compiled kernels cannot be kept."""


_kept = True


def keeps_compiled() -> bool:
    """Whether what this process compiles is there for others."""
    return _kept


def choose_cache() -> None:
    """Give numba a folder for compiled kernels, before the first kernel is defined.

    The first that can be written to: `NUMBA_CACHE_DIR`, the package, the user's cache folder,
    `ROS_HOME`, a folder of the user's own in the temporary directory or in shared memory. Kernels
    that were compiled into a package which is read-only now are copied there. Where there is none
    they are read from the package, and what is missing is compiled at every start.

    Warns
    -----
    CacheWarning
        There is none.
    """
    given = os.environ.get('NUMBA_CACHE_DIR')
    if given and writable(Path(given)):
        _keep_in(Path(given))
        return
    if writable(PACKAGE / 'core' / '__pycache__'):
        drop_outdated(PACKAGE)
        return
    for folder in _folders():
        if writable(folder):
            _copy_compiled(_keep_in(folder))
            return
    warnings.warn(
        'compiled kernels cannot be kept, so that every start compiles them: no folder can be '
        'written to; set NUMBA_CACHE_DIR to one that can',
        CacheWarning,
        stacklevel=2,
    )
    _only_read()


def _keep_in(folder: Path) -> Path:
    """Have numba keep kernels in a folder within `folder`, one for each state of the sources."""
    state = hashlib.sha256(repr(stamps(PACKAGE)).encode()).hexdigest()
    name = f'rangeseg_ros-{state[:16]}'
    # Other than a process that was told of it by the one that started it.
    if folder.name != name:
        folder /= name
        folder.mkdir(exist_ok=True)
    os.environ['NUMBA_CACHE_DIR'] = os.fspath(folder)
    if 'numba' in sys.modules:
        sys.modules['numba'].config.CACHE_DIR = os.fspath(folder)
    return folder


def _folders() -> Iterator[Path]:
    cache = os.environ.get('XDG_CACHE_HOME')
    home = os.environ.get('HOME')
    if cache or home:
        yield (Path(cache) if cache else Path(home or '', '.cache')) / 'rangeseg_ros'
    if ros_home := os.environ.get('ROS_HOME'):
        yield Path(ros_home) / 'rangeseg_ros'
    for temporary in _temporary_folders():
        own = temporary / f'rangeseg_ros-{os.getuid()}'
        if _private(own):
            yield own


def _temporary_folders() -> Iterator[Path]:
    if not hasattr(os, 'getuid'):
        return
    with suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir())
    # Memory: containers with a read-only root have it, too, and it lasts as long as they do.
    yield Path('/dev/shm')


def _private(folder: Path) -> bool:
    """Make the folder, or find it made, so that nobody else can write to it.

    What is in it is executed.
    """
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    return (
        stat.S_ISDIR(found.st_mode)
        and found.st_uid == os.getuid()
        and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    )


def writable(folder: Path) -> bool:
    """Whether files can be made in the folder, which is made where it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


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


def _only_read() -> None:
    """Have numba take what is compiled in the package, and keep nothing."""
    global _kept
    _kept = False
    from numba.core import caching

    # Their names had underscores once.
    kinds: dict[str, Any] = {name.lstrip('_'): kind for name, kind in vars(caching).items()}

    beside_source = kinds['InTreeCacheLocator']
    readable = type('Readable', (beside_source,), {'ensure_cache_path': lambda self: None})
    kinds['CacheImpl']._locator_classes.append(readable)
    kinds['FunctionCache'].save_overload = lambda self, sig, data: None
