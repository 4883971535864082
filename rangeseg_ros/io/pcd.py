"""Organised point clouds in PCD files: ascii, binary and binary_compressed."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_SIZES = {'F': (4, 8), 'I': (1, 2, 4, 8), 'U': (1, 2, 4, 8)}


class PcdError(ValueError):
    """A file that is no readable PCD file."""


def read_pcd(path: Path) -> dict[str, NDArray]:
    """Read the fields of a PCD file.

    Returns
    -------
    dict
        Field name -> (H, W) array in the type of the file, or (H, W, n) for a field of n values.
        An unorganised cloud has H = 1.

    Raises
    ------
    PcdError
        A missing or truncated file, or a malformed header; the message names the fault.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PcdError(f'{path}: {error.strerror}') from None
    try:
        return _parse(data)
    except PcdError as error:
        raise PcdError(f'{path}: {error}') from None
    except (ValueError, OverflowError, MemoryError):
        raise PcdError(f'{path}: malformed or far too large') from None


def _parse(data: bytes) -> dict[str, NDArray]:
    header, body = _split(data)
    dtype, shape = _layout(header)
    points = shape[0] * shape[1]
    kind = header['DATA'][0].lower()
    if kind == 'ascii':
        return _columns(_ascii(body, dtype, points), shape)
    if kind == 'binary':
        return _columns(_records(body, dtype, points), shape)
    if kind != 'binary_compressed':
        raise PcdError(f'unknown DATA {kind!r}')
    if len(body) < 8:
        raise PcdError('truncated')
    compressed, size = struct.unpack_from('<II', body)
    if len(body) < 8 + compressed:
        raise PcdError(f'truncated: {len(body) - 8} of {compressed} compressed bytes')
    if size != dtype.itemsize * points:
        raise PcdError(f'{size} bytes of points where the header announces {points} points')
    raw = lzf_decompress(body[8 : 8 + compressed], size)
    # Compressed files hold one field after the other, not one point after the other.
    fields = {}
    start = 0
    for name in dtype.names or ():
        part = dtype[name]
        block = np.frombuffer(raw, part.base, points * int(np.prod(part.shape)), start)
        fields[name] = block.reshape(*shape, *part.shape).copy()
        start += part.itemsize * points
    return fields


def _split(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Header entries, and what follows the DATA line."""
    header: dict[str, list[str]] = {}
    start = 0
    while 'DATA' not in header:
        end = data.find(b'\n', start, start + 10000)
        if end < 0:
            raise PcdError('not a PCD file (no DATA line)')
        words = data[start:end].decode('latin-1').split()
        start = end + 1
        if words and not words[0].startswith('#'):
            header[words[0].upper()] = words[1:]
    if not header['DATA']:
        raise PcdError('empty DATA line')
    return header, data[start:]


def _layout(header: dict[str, list[str]]) -> tuple[np.dtype, tuple[int, int]]:
    for key in ('FIELDS', 'SIZE', 'TYPE', 'WIDTH', 'HEIGHT'):
        if not header.get(key):
            raise PcdError(f'the header lacks {key}')
    names = header['FIELDS']
    columns = [header['SIZE'], header['TYPE'], header.get('COUNT', ['1'] * len(names))]
    if any(len(column) != len(names) for column in columns) or len(set(names)) < len(names):
        raise PcdError('FIELDS, SIZE, TYPE and COUNT of the header do not agree')
    try:
        width, height = int(header['WIDTH'][0]), int(header['HEIGHT'][0])
        entries = []
        for name, size, kind, count in zip(names, *columns, strict=True):
            if int(size) not in _SIZES[kind] or int(count) < 1:
                raise ValueError
            shape = () if int(count) == 1 else (int(count),)
            entries.append((name, f'<{kind.lower()}{size}', shape))
    except (ValueError, KeyError):
        raise PcdError('malformed SIZE, TYPE, COUNT, WIDTH or HEIGHT in the header') from None
    if width < 1 or height < 1:
        raise PcdError(f'empty cloud: {width}x{height}')
    return np.dtype(entries), (height, width)


def _records(body: bytes, dtype: np.dtype, points: int) -> NDArray:
    if len(body) < dtype.itemsize * points:
        raise PcdError(f'truncated: {len(body) // dtype.itemsize} of {points} points')
    return np.frombuffer(body, dtype, points)


def _ascii(body: bytes, dtype: np.dtype, points: int) -> NDArray:
    lines = body.split(b'\n')[:points]
    if len(lines) < points:
        raise PcdError(f'malformed or truncated: expected {points} lines of numbers')
    records = np.zeros(points, dtype)
    widths = [int(np.prod(dtype[name].shape)) for name in dtype.names or ()]
    try:
        table = np.array([[float(word) for word in line.split()] for line in lines])
        if table.shape != (points, sum(widths)):
            raise ValueError
    except ValueError:
        raise PcdError(f'malformed or truncated: expected {points} lines of numbers') from None
    for name, part in zip(
        dtype.names or (), np.split(table, np.cumsum(widths)[:-1], axis=1), strict=True
    ):
        with np.errstate(invalid='ignore'):
            records[name] = part.reshape(records[name].shape)
    return records


def _columns(records: NDArray, shape: tuple[int, int]) -> dict[str, NDArray]:
    return {
        name: records[name].reshape(*shape, *records.dtype[name].shape).copy()
        for name in records.dtype.names or ()
    }


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Decompress LZF (Lehmann's LibLZF) into `size` bytes.

    Raises
    ------
    PcdError
        Damaged data.
    """
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end:
            control = data[position]
            position += 1
            if control < 32:  # control + 1 literal bytes
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[position]
                position += 1
            length += 2
            start = len(out) - ((control & 31) << 8) - data[position] - 1
            position += 1
            if start < 0:
                raise IndexError
            copied = out[start : start + length]
            while len(copied) < length:  # a copy may run into what it writes
                copied += copied[: length - len(copied)]
            out += copied
    except IndexError:
        raise PcdError('damaged LZF data') from None
    if len(out) != size:
        raise PcdError(f'damaged LZF data: {len(out)} bytes, not {size}')
    return bytes(out)
