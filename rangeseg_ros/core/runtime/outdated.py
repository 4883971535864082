"""Compiled kernels that the sources have left behind.

numba compiles a kernel anew when its file has changed, before 0.68 when its time or size has, but
not when that of a kernel it calls has: after an update in place it would go on with what was
compiled into it.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
from pathlib import Path

_STAMPS = Path('core', '__pycache__', 'compiled_from.json')


def drop_outdated(package: Path) -> None:
    """Remove the kernels of all modules whose sources, or those of what they import, have changed.

    Parameters
    ----------
    package : Path
        With the compiled kernels beside the sources, and a note of these: what they were when it
        was looked at last.
    """
    note = package / _STAMPS
    now = stamps(package)
    try:
        before = json.loads(note.read_text())
    except (OSError, ValueError):
        before = {}
    if now == before:
        return
    changed = {name for name in now.keys() | before.keys() if now.get(name) != before.get(name)}
    for module in _dependents(package, changed):
        for compiled in (module.parent / '__pycache__').glob(f'{module.stem}.*.nb[ic]'):
            compiled.unlink(missing_ok=True)
    part = note.with_name(f'{note.name}.{os.getpid()}')
    part.write_text(json.dumps(now))
    os.replace(part, note)


def stamps(package: Path) -> dict[str, str]:
    """Digests of the sources of the core, by name: times of change may be those of an archive."""
    return {
        path.relative_to(package).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted((package / 'core').rglob('*.py'))
    }


def _dependents(package: Path, changed: set[str]) -> set[Path]:
    """The changed modules and all that import one of them, or one that does."""
    imports = {}
    for path in (package / 'core').rglob('*.py'):
        tree = ast.parse(path.read_text(encoding='utf-8'))
        imports[path] = {
            name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module
            for name in (node.module, *(f'{node.module}.{item.name}' for item in node.names))
        }
    found, last = {package / name for name in changed}, 0
    while len(found) > last:
        last = len(found)
        names = {_dotted(package, path) for path in found}
        found |= {path for path, imported in imports.items() if imported & names}
    return found


def _dotted(package: Path, path: Path) -> str:
    parts = path.relative_to(package.parent).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)
