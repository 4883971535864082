"""Organised point clouds in PLY files: ascii and binary."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_TYPES = {
    **{'char': 'i1', 'uchar': 'u1', 'short': 'i2', 'ushort': 'u2', 'int': 'i4', 'uint': 'u4'},
    **{'int8': 'i1', 'uint8': 'u1', 'int16': 'i2', 'uint16': 'u2', 'int32': 'i4'},
    **{'uint32': 'u4', 'float': 'f4', 'double': 'f8', 'float32': 'f4', 'float64': 'f8'},
}
# Keywords of writers for the size of the image.
_SIZES = ('width', 'num_cols', 'cols'), ('height', 'num_rows', 'rows')


class PlyError(ValueError):
    """A file that is no readable PLY file, or no organised cloud."""


def read_ply(path: Path, shape: tuple[int, int] | None = None) -> NDArray[np.floating]:
    """Points (H, W, 3) of a PLY file, in the unit of the file.

    Parameters
    ----------
    path : Path
    shape : (int, int), optional
        (H, W) where the header does not state it, as `obj_info num_cols 640` does.

    Raises
    ------
    PlyError
        A missing or damaged file, no vertices first, or a number of points that is not H x W.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PlyError(f'{path}: {error.strerror}') from None
    head, found, body = data.partition(b'end_header')
    if not data.startswith(b'ply') or not found:
        raise PlyError(f'{path}: not a PLY file')
    header = head.decode('latin-1')
    element = re.search(r'element vertex (\d+)\s+((?:property .*\s+)+)', header)
    order = re.search(r'format (ascii|binary_little_endian|binary_big_endian)', header)
    if not element or not order or 'element' in header[: element.start()]:
        raise PlyError(f'{path}: no vertices at its begin')
    fields = [line.split()[1:] for line in element[2].strip().splitlines()]
    if any(len(field) != 2 or field[0] not in _TYPES for field in fields):
        raise PlyError(f'{path}: vertices with lists')
    names, count = [name for _, name in fields], int(element[1])
    body = body[body.find(b'\n') + 1 :]
    try:
        if order[1] == 'ascii':
            rows = [line.split() for line in body.splitlines()[:count]]
            table = np.array(rows, float).reshape(count, len(names))
            columns = dict(zip(names, table.T, strict=True))
        else:
            sign = '<' if 'little' in order[1] else '>'
            kind = np.dtype([(name, sign + _TYPES[word]) for word, name in fields])
            records = np.frombuffer(body, kind, count)
            columns = {name: records[name] for name in names}
        points = np.stack([columns[axis].astype(np.float32) for axis in 'xyz'], axis=-1)
    except (ValueError, KeyError, MemoryError):
        raise PlyError(f'{path}: truncated, or without x, y, z') from None
    said = [re.search(rf'\b(?:{"|".join(words)})\s+(\d+)', header) for words in _SIZES]
    if said[0] and said[1]:
        shape = int(said[1][1]), int(said[0][1])
    return organised(points, shape, path)


def organised(
    points: NDArray[np.floating], shape: tuple[int, int] | None, path: Path
) -> NDArray[np.floating]:
    """Points (N, 3) of a file as (H, W, 3); PlyError unless N is H x W of a `shape` (H, W)."""
    if shape is None or len(points) != shape[0] * shape[1]:
        raise PlyError(
            f'{path}: {len(points)} points, not an organised cloud of known width and height '
            '(--camera tells them where no point was left out)'
        )
    return points.reshape(*shape, 3)
