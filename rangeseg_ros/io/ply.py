"""Organised point clouds in PLY files: ascii and binary."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.io.files import FileError, read_bytes

_TYPES = {
    **{'char': 'i1', 'uchar': 'u1', 'short': 'i2', 'ushort': 'u2', 'int': 'i4', 'uint': 'u4'},
    **{'int8': 'i1', 'uint8': 'u1', 'int16': 'i2', 'uint16': 'u2', 'int32': 'i4'},
    **{'uint32': 'u4', 'float': 'f4', 'double': 'f8', 'float32': 'f4', 'float64': 'f8'},
}
# Keywords of writers for the size of the image.
_SIZES = ('width', 'num_cols', 'cols'), ('height', 'num_rows', 'rows')


def read_ply(path: Path, shape: tuple[int, int] | None = None) -> NDArray[np.floating]:
    """Points (H, W, 3) of a PLY file, in the unit of the file.

    `shape` (H, W) counts where the header does not state it, as `obj_info num_cols 640` does.
    FileError: a damaged file, no vertices first, or a number of points that is not H x W.
    """
    head, found, body = read_bytes(path).partition(b'end_header')
    if not head.startswith(b'ply') or not found:
        raise FileError(f'{path}: not a PLY file')
    header = head.decode('latin-1')
    element = re.search(r'element vertex (\d+)\s+((?:property .*\s+)+)', header)
    order = re.search(r'format (ascii|binary_little_endian|binary_big_endian)', header)
    if not element or not order or 'element' in header[: element.start()]:
        raise FileError(f'{path}: no vertices at its beginning')
    fields = [line.split()[1:] for line in element[2].strip().splitlines()]
    if any(len(field) != 2 or field[0] not in _TYPES for field in fields):
        raise FileError(f'{path}: vertices with lists')
    sign = '>' if 'big' in order[1] else '<'
    body, count = body[body.find(b'\n') + 1 :], int(element[1])
    try:
        if order[1] == 'ascii':
            rows = [line.split() for line in body.splitlines()[:count]]
            table = np.array(rows, float).reshape(count, len(fields))
            records: Any = {name: table[:, k] for k, (_, name) in enumerate(fields)}
        else:
            kind = np.dtype([(name, sign + _TYPES[word]) for word, name in fields])
            records = np.frombuffer(body, kind, count)
        points = np.stack([records[axis].astype(np.float32) for axis in 'xyz'], axis=-1)
    except (ValueError, KeyError, MemoryError, OverflowError):
        raise FileError(f'{path}: truncated, or without x, y, z') from None
    said = [re.search(rf'\b(?:{"|".join(words)})\s+(\d+)', header) for words in _SIZES]
    if said[0] and said[1]:
        shape = int(said[1][1]), int(said[0][1])
    return organised(points, shape, path)


def organised(
    points: NDArray[np.floating], shape: tuple[int, int] | None, path: Path
) -> NDArray[np.floating]:
    """Points (N, 3) of a file as (H, W, 3); FileError unless N is H x W of a `shape` (H, W)."""
    if shape is None or len(points) != shape[0] * shape[1]:
        known = f'the camera has {shape[1]}x{shape[0]}' if shape else 'no --camera tells its size'
        raise FileError(
            f'{path}: {len(points)} points, not one for each pixel of an organised cloud; {known}'
        )
    return points.reshape(*shape, 3)
