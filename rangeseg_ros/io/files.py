"""Files that are whole or not there, and the order of their names."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary place for a file or folder of the name of `path`.

    On success it is moved to `path`; after an exception or an interruption nothing is left.
    """
    folder = path.with_name(f'.{os.getpid()}.{path.name}')
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder / path.name
        os.replace(folder / path.name, path)
    finally:
        try:
            shutil.rmtree(folder, ignore_errors=True)
        except KeyboardInterrupt:
            # It may come just here.
            shutil.rmtree(folder, ignore_errors=True)
            raise


def natural_order(path: Path) -> list[str | int]:
    """Sort key that puts frame_2 before frame_10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', path.name)]
