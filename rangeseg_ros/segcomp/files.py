"""The file kinds of the segmentation comparison of Hoover et al.; all raise SegcompError.

Their regions are numbered from 10; here they are 1, 2, ..., and 0 is none.

References
----------
A. Hoover et al., "An experimental comparison of range image segmentation algorithms", IEEE TPAMI
18(7), 1996.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FIRST_REGION = 10
EDGE = 3
SIZE = 512

_MAGIC = 0x59A66A95
_PERCEPTRON_WORDS = (2, 2, 3, 3, 3, 3, 4, 4, 3, 5)
_RANGE_MASK = 4095


class SegcompError(ValueError):
    """A file that breaks the segcomp conventions."""


def read_raster(path: str | os.PathLike[str]) -> NDArray[np.uint8]:
    """Read an uncompressed 8-bit Sun raster (H, W), such as an ABW range image: 0 is shadow."""
    data = Path(path).read_bytes()
    if len(data) < 4 or struct.unpack_from('>I', data)[0] != _MAGIC:
        raise SegcompError(f'{path}: not a Sun raster (wrong magic number)')
    if len(data) < 32:
        raise SegcompError(f'{path}: truncated Sun raster: the header has {len(data)} of 32 bytes')
    width, height, depth, _, kind, _, colormap = struct.unpack_from('>7i', data, 4)
    if width < 1 or height < 1 or colormap < 0:
        raise SegcompError(f'{path}: malformed Sun raster header: size {width}x{height}')
    if depth != 8:
        raise SegcompError(f'{path}: Sun raster has {depth} bits per pixel, not 8')
    if kind not in (0, 1):
        raise SegcompError(f'{path}: Sun raster of type {kind}; only uncompressed ones (0, 1)')
    pixels = data[32 + colormap : 32 + colormap + width * height]
    if len(pixels) < width * height:
        found = f'{len(pixels)} of {width * height} pixels'
        raise SegcompError(f'{path}: truncated Sun raster: {found}')
    return np.frombuffer(pixels, np.uint8).reshape(height, width).copy()


def read_segmentation(path: str | os.PathLike[str]) -> NDArray[np.uint16]:
    """Read the labels (H, W) of a `.gt-seg` or `.ms-seg` raster.

    In the file 0 is none, 1 noise, 2 shadow, 3 edge; 4 to 9 are not allowed.
    """
    image = read_raster(path)
    bad = image[(image > EDGE) & (image < FIRST_REGION)]
    if bad.size:
        raise SegcompError(f'{path}: label {bad.min()}; 4..9 are not allowed, regions begin at 10')
    return np.maximum(image, FIRST_REGION - 1).astype(np.uint16) - np.uint16(FIRST_REGION - 1)


def read_perceptron(path: str | os.PathLike[str]) -> NDArray[np.uint16]:
    """Read the 12-bit range values (512, 512) of a Perceptron image, not its reflectance."""
    data = Path(path).read_bytes()
    start = 0
    for number, words in enumerate(_PERCEPTRON_WORDS, start=1):
        end = data.find(b'\n', start, start + 1000)
        if end < 0 or len(data[start:end].split()) != words:
            problem = f'header line {number} must have {words} words'
            raise SegcompError(f'{path}: not a Perceptron image: {problem}')
        start = end + 1
    pixels = data[start + 2 :]
    expected = 4 * SIZE * SIZE
    if len(pixels) != expected:
        problem = 'truncated' if len(pixels) < expected else 'oversized'
        found = f'{len(pixels)} bytes of pixels, not {expected}'
        raise SegcompError(f'{path}: {problem} Perceptron image: {found}')
    values = np.frombuffer(pixels, '>i4').reshape(SIZE, SIZE)
    return (values & _RANGE_MASK).astype(np.uint16)


def read_angles(path: str | os.PathLike[str]) -> list[tuple[int, int, float]]:
    """Read a `.gt-ang` file: a count, then lines `regionA regionB degrees`."""
    return [(_label(a), _label(b), angle) for a, b, angle in _read_rows(path, 3, integers=2)]


def read_normals(path: str | os.PathLike[str]) -> dict[int, NDArray[np.float64]]:
    """Read a `.ms-nor` file: a count, then lines `label nx ny nz`."""
    return {_label(row[0]): np.array(row[1:]) for row in _read_rows(path, 4, integers=1)}


def _label(number: float) -> int:
    """Label of a region, by its number in a file."""
    return int(number) - FIRST_REGION + 1


def _read_rows(path: str | os.PathLike[str], columns: int, integers: int) -> list[list[float]]:
    """Rows of a counted table whose first `integers` columns are whole numbers."""
    lines = [line.split() for line in Path(path).read_text(errors='replace').splitlines()]
    lines = [words for words in lines if words]
    try:
        (count,) = (int(word) for word in lines[0])
    except (IndexError, ValueError):
        raise SegcompError(f'{path}: the first line must be a count') from None
    if len(lines) - 1 != count:
        raise SegcompError(f'{path}: {len(lines) - 1} lines where the first announces {count}')
    rows = []
    for number, words in enumerate(lines[1:], start=1):
        try:
            row = [float(int(word)) for word in words[:integers]]
            row += [float(word) for word in words[integers:]]
        except (ValueError, OverflowError):
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise SegcompError(f'{path}: malformed entry {number}: {" ".join(words)[:60]!r}')
        rows.append(row)
    return rows
