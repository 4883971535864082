"""Organised point clouds in PCD files: ascii, binary and binary_compressed."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.lib import recfunctions
from numpy.typing import NDArray

from rangeseg_ros.io.files import FileError, read_bytes


def read_pcd(path: Path) -> dict[str, NDArray]:
    """Fields of a PCD file by their names, in the type of the file; FileError names a fault.

    Arrays (H, W), or (H, W, n) for a field of n values. An unorganised cloud has H = 1.
    """
    data = read_bytes(path)
    try:
        header, body = _split(data)
        kind, (shape, dtype) = header['DATA'][0].lower(), _layout(header)
        points = shape[0] * shape[1]
        if kind == 'ascii':
            records = _ascii(body, dtype, points)
        elif kind == 'binary':
            records = np.frombuffer(_first(body, dtype.itemsize * points), dtype)
        elif kind == 'binary_compressed':
            records = _compressed(body, dtype, points)
        else:
            raise FileError(f'unknown DATA {kind!r}')
    except FileError as error:
        raise FileError(f'{path}: {error}') from None
    except (ValueError, TypeError, IndexError, OverflowError, MemoryError, struct.error):
        raise FileError(f'{path}: malformed or truncated') from None
    return {name: records.reshape(shape)[name].copy() for name in dtype.names or ()}


def _split(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Header entries, and what follows the DATA line."""
    header: dict[str, list[str]] = {}
    start = 0
    while 'DATA' not in header:
        end = data.find(b'\n', start, start + 10000)
        if end < 0:
            raise FileError('not a PCD file (no DATA line)')
        words = data[start:end].decode('latin-1').split()
        start = end + 1
        if words and not words[0].startswith('#'):
            header[words[0].upper()] = words[1:]
    return header, data[start:]


def _layout(header: dict[str, list[str]]) -> tuple[tuple[int, int], np.dtype]:
    """Height and width, and the type of a point."""
    for key in ('FIELDS', 'SIZE', 'TYPE', 'WIDTH', 'HEIGHT'):
        if not header.get(key):
            raise FileError(f'the header lacks {key}')
    names = header['FIELDS']
    entries = []
    for name, size, kind, count in zip(
        names, header['SIZE'], header['TYPE'], header.get('COUNT', ['1'] * len(names)), strict=True
    ):
        if kind not in tuple('FIU') or int(count) < 1:
            raise FileError(f'malformed field {name} in the header')
        shape = () if int(count) == 1 else (int(count),)
        entries.append((name, f'<{kind.lower()}{size}', shape))
    height, width = int(header['HEIGHT'][0]), int(header['WIDTH'][0])
    if width < 1 or height < 1:
        raise FileError(f'empty cloud: {width}x{height}')
    return (height, width), np.dtype(entries)


def _first(data: bytes, size: int) -> bytes:
    if len(data) < size:
        raise FileError(f'truncated: {len(data)} of {size} bytes')
    return data[:size]


def _ascii(body: bytes, dtype: np.dtype, points: int) -> NDArray:
    rows = [[float(word) for word in line.split()] for line in body.split(b'\n')[:points]]
    if len(rows) < points:
        raise FileError(f'truncated: {len(rows)} of {points} points')
    with np.errstate(invalid='ignore'):
        return recfunctions.unstructured_to_structured(np.array(rows), dtype, casting='unsafe')


def _compressed(body: bytes, dtype: np.dtype, points: int) -> NDArray:
    """Compressed points, which hold one field after the other."""
    stored, size = struct.unpack_from('<II', body)
    if size != dtype.itemsize * points:
        raise FileError(f'{size} bytes of points where the header announces {points} points')
    raw = lzf_decompress(_first(body[8:], stored), size)
    records, start = np.empty(points, dtype), 0
    for name in dtype.names or ():
        records[name] = np.frombuffer(raw, dtype[name], points, start)
        start += dtype[name].itemsize * points
    return records


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Decompress LZF (Lehmann's LibLZF) into `size` bytes; FileError on damaged data."""
    out = bytearray()
    position = 0
    try:
        while position < len(data):
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
        raise FileError('damaged LZF data') from None
    if len(out) != size:
        raise FileError(f'damaged LZF data: {len(out)} bytes, not {size}')
    return bytes(out)
