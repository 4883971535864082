"""Where compiled kernels are kept: what is read from there is executed.

numba keeps them beside the sources, or in a folder that it is given. It does not notice when what
a kernel calls has changed.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import re
import shutil
import stat
import sys
import tempfile
import warnings
from importlib import metadata
from pathlib import Path

PACKAGE = Path(__file__).parent
# Beside the kernels of the core: what all kernels of the package were compiled from, see `_state`.
_SOURCES = Path('core', '__pycache__', 'compiled_from.json')
# The same of wheels with compiled kernels: their processor, and version of numba.
_TARGET = Path('core', '__pycache__', 'compiled_for.json')
# Instructions of llvm's processors for which wheels are compiled.
_FEATURES = {'x86-64-v3': ('avx2', 'bmi', 'bmi2', 'f16c', 'fma', 'lzcnt', 'movbe')}
# Modules and the names imported from them, which may be modules.
_IMPORT = re.compile(r'^from (\S+) import (\([^)]*\)|.*)$', re.MULTILINE)


class CacheWarning(UserWarning):
    """Compiled kernels cannot be kept, or not where they were to be."""


def choose_cache() -> None:
    """Give numba a folder for compiled kernels, before the first kernel is defined.

    The first that can be written to, and not by other users: `NUMBA_CACHE_DIR`, the package
    (whoever can write there can change the sources), the user's cache folder, a temporary one for
    this process. Kernels that were compiled into a package which is read-only are copied there.
    `CacheWarning` where `NUMBA_CACHE_DIR` is not used or the folder is temporary; OSError if none.
    """
    _choose_processor()
    given = os.environ.pop('NUMBA_CACHE_DIR', None)
    folder = _own_folder(Path(given)) if given else None
    if given and folder is None:
        _warn(f'NUMBA_CACHE_DIR: {given} is not used: not writable, or writable by other users')
    if folder is None and writable(PACKAGE / 'core' / '__pycache__'):
        drop_outdated(PACKAGE)
    elif folder is None:
        home = os.environ.get('HOME')
        user = os.environ.get('XDG_CACHE_HOME') or (home and os.path.join(home, '.cache'))
        folder = _own_folder(Path(user, 'rangeseg_ros')) if user else None
        folder = folder or _temporary_folder()
        _copy_compiled(folder)
    if folder:
        # Of processes started from here, too.
        os.environ['NUMBA_CACHE_DIR'] = os.fspath(folder)
    if 'numba' in sys.modules:
        sys.modules['numba'].config.CACHE_DIR = os.fspath(folder or '')


def _choose_processor() -> None:
    """Have numba compile for the processor of the kernels in the package, as numba names these."""
    target = _read(PACKAGE / _TARGET)
    if not target or 'NUMBA_CPU_NAME' in os.environ:
        return
    from llvmlite import binding

    has = binding.get_host_cpu_features()
    if not all(has.get(feature) for feature in _FEATURES.get(target['cpu'], ())):
        _warn(f'the compiled kernels are for a {target["cpu"]}: they are compiled anew')
    elif target['numba'] != (found := metadata.version('numba')):
        _warn(f'the compiled kernels are of numba {target["numba"]}: {found} compiles them anew')
    else:
        os.environ.update(NUMBA_CPU_NAME=target['cpu'], NUMBA_CPU_FEATURES='')
        if 'numba' in sys.modules:
            sys.modules['numba'].config.reload_config()


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
    state = hashlib.sha256(repr(_state(PACKAGE)).encode()).hexdigest()
    name = f'rangeseg_ros-{state[:16]}'
    # `root` has this name already where the parent process has set NUMBA_CACHE_DIR.
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
    for path in (folder, *folder.resolve().parents):
        found = path.lstat()
        others = stat.S_IWOTH if found.st_gid == found.st_uid else stat.S_IWOTH | stat.S_IWGRP
        # Where the sticky bit is set, as for /tmp, nobody can replace what others have in there.
        sticky = path != folder and found.st_mode & stat.S_ISVTX
        if found.st_uid not in (0, os.getuid()) or (found.st_mode & others and not sticky):
            return False
    return True


def _temporary_folder() -> Path:
    """Folder that goes with the process."""
    try:
        folder = Path(tempfile.mkdtemp(prefix='rangeseg_ros-'))
    except OSError:
        raise OSError(
            'no folder for compiled kernels can be written to; set NUMBA_CACHE_DIR to one'
        ) from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    _warn('compiled kernels last as long as the process; set NUMBA_CACHE_DIR to a folder of yours')
    return folder


def drop_outdated(package: Path) -> None:
    """Remove kernels compiled beside sources that have changed, or that import such sources.

    If numba has changed, remove all: it reads the index of a kernel before its code, and would run
    or reject old code if only one of them was replaced, as on a full disk.
    """
    note, now = package / _SOURCES, _state(package)
    before = _read(note)
    if now == before:
        return
    changed = {name for name, _ in now.items() ^ before.items()}
    outdated = _dependents(package, changed)
    for compiled in package.rglob('__pycache__/*.nb[ic]'):
        source = compiled.parents[1] / compiled.name.partition('.')[0]
        name = '.'.join(source.relative_to(package.parent).parts)
        if 'numba' in changed or name in outdated:
            compiled.unlink(missing_ok=True)
    _replace(note, json.dumps(now).encode())


def _state(package: Path) -> dict[str, str]:
    """What kernels are compiled from: the sources of the core, and the version of numba."""
    return {**_digests(package), 'numba': metadata.version('numba')}


def _read(note: Path) -> dict[str, str]:
    """What was noted; nothing where that cannot be read."""
    try:
        return dict(json.loads(note.read_text()))
    except (OSError, ValueError):
        return {}


def _digests(package: Path) -> dict[str, str]:
    """Digests of the sources of the core by module: times of change may be those of an archive."""
    digests = {}
    for path in sorted((package / 'core').rglob('*.py')):
        name = '.'.join(path.relative_to(package.parent).with_suffix('').parts)
        digests[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return digests


def _dependents(package: Path, changed: set[str]) -> set[str]:
    """The changed modules and all that import one of them, or one that does."""
    imports: dict[str, set[str]] = {}
    for name in _digests(package):
        text = (package.parent / name.replace('.', '/')).with_suffix('.py').read_text()
        imports[name] = set()
        for module, items in _IMPORT.findall(text):
            imports[name] |= {module, *(f'{module}.{item}' for item in re.findall(r'\w+', items))}
    while more := {name for name, found in imports.items() if found & changed} - changed:
        changed = changed | more
    return changed


def _copy_compiled(folder: Path) -> None:
    """Copy kernels compiled into the package to where numba looks for them in `folder`."""
    if _read(PACKAGE / _SOURCES) != _state(PACKAGE):
        return
    from numba.core.caching import _CacheLocator

    for compiled in PACKAGE.rglob('__pycache__/*.nb[ic]'):
        source = compiled.parents[1] / '__init__.py'
        target = folder / _CacheLocator.get_suitable_cache_subpath(source) / compiled.name
        if not target.exists():
            target.parent.mkdir(exist_ok=True)
            _replace(target, compiled.read_bytes())


def _replace(path: Path, content: bytes) -> None:
    """Write a file that is complete whenever it is there."""
    part = path.with_name(f'{path.name}.{os.getpid()}')
    part.write_bytes(content)
    os.replace(part, path)


def _warn(text: str) -> None:
    warnings.warn(text, CacheWarning, stacklevel=3)
