"""Digests that tell whether results are those of this code, these parameters and files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path


@cache
def code_digest() -> bytes:
    """Digest of every source and page of the package, by name and content."""
    package = Path(__file__).parent
    digest = hashlib.sha256()
    sources = [path for kind in ('*.py', '*.html') for path in package.rglob(kind)]
    for path in sorted(sources):
        digest.update(str(path.relative_to(package)).encode() + b'\0')
        digest.update(path.read_bytes() + b'\0')
    return digest.digest()


def result_key(settings: object, read: Iterable[Path], recorded: Iterable[Path]) -> str:
    """Digest of the code, of settings, of the content of files, and of the state of large ones."""
    digest = hashlib.sha256(code_digest() + repr(settings).encode())
    for path in read:
        digest.update(path.read_bytes())
    for path in sorted(recorded):
        state = path.stat()
        digest.update(repr((path.name, state.st_size, state.st_mtime_ns)).encode())
    return digest.hexdigest()[:16]
