"""Digest of the package's sources: what caches of results are valid for."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path


@cache
def code_digest() -> bytes:
    """Digest of every source and template of the package, by name and content."""
    package = Path(__file__).parent
    digest = hashlib.sha256()
    sources = [path for kind in ('*.py', '*.html') for path in package.rglob(kind)]
    for path in sorted(sources):
        digest.update(str(path.relative_to(package)).encode() + b'\0')
        digest.update(path.read_bytes() + b'\0')
    return digest.digest()
