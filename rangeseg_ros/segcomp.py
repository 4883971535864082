"""The sets of the segmentation comparison of Hoover et al.: their files and their scanners.

Their regions are numbered from 10; here they are 1, 2, ..., and 0 is none. Points are in metres in
the optical frame: x right, y down, z forward. Malformed files raise SegcompError.

References
----------
A. Hoover et al., "An experimental comparison of range image segmentation algorithms", IEEE TPAMI
18(7), 1996; geometry as in its published conversion program, range-to-coords.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage

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


def read_normals(path: str | os.PathLike[str]) -> dict[int, Floats]:
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


@dataclass(frozen=True)
class AbwCalibration:
    """Geometry of the ABW structured-light scanner, a pinhole camera.

    The published formulas x = (c - 255) (v / scale + offset) / |f|,
    y = (255 - r) / aspect (v / scale + offset) / |f|, z = (255 - v) / scale describe rays through
    one centre at the depth v / scale + offset; here they are given in the optical frame of that
    centre (x right, y down, z forward, metres; the published unit is taken as the millimetre).
    `offset` is the depth of range value 0, mm; `scale` range values per mm; `focal` in columns.
    """

    offset: float
    scale: float
    focal: float

    _ASPECT = 1.4508

    @property
    def camera(self) -> Camera:
        """The scanner as a camera: 512 x 512, pixels lower than wide."""
        return Camera(SIZE, SIZE, self.focal, self.focal * self._ASPECT, 255.0, 255.0)

    def depth(self, values: ArrayLike) -> Floats:
        """Depth in metres of range values; NaN for 0, which is shadow."""
        array = np.asarray(values, dtype=float)
        return np.where(array == 0, np.nan, (array / self.scale + self.offset) * 1e-3)


ABW_FIRST = AbwCalibration(785.410786, 0.773545, 1610.981722)
ABW_SECOND = AbwCalibration(771.016866, 0.791686, 1586.072821)
_FIRST_TEST_IMAGES = frozenset((0, 19, 21, 25, 27, 28, 29))


def abw_calibration(number: int, split: str = 'test') -> AbwCalibration:
    """Calibration of an ABW image, by its number in the `test` or `train` set."""
    return ABW_FIRST if split == 'test' and number in _FIRST_TEST_IMAGES else ABW_SECOND


def abw_range_image(values: ArrayLike, calibration: AbwCalibration) -> RangeImage:
    """Range image of (512, 512) ABW range values."""
    _check_size(values, 'ABW')
    return RangeImage.from_depth(calibration.depth(values).astype(np.float32), calibration.camera)


# The published program names no unit. With 4096 steps of 0.20236 the range covers 829 units:
# 8.3 m in centimetres, the ambiguity interval of an 18 MHz modulation, and mirrors 3 and 5.5 cm
# apart; millimetres would put the mirrors 3 mm from each other.
_PERCEPTRON_UNIT = 0.01
_STEP = 0.20236
_STANDOFF = 830.3


def perceptron_points(values: ArrayLike) -> Floats:
    """Points (512, 512, 3) of range values (512, 512) of the Perceptron laser scanner, metres.

    It has no single centre: its beams leave a rotating mirror and a nodding one. The origin is at
    the second mirror.
    """
    h1, h2 = 3.0, 5.5
    gamma = theta = np.pi / 4
    pixel = np.arange(SIZE)
    alpha = np.radians(51.65 * (255.5 - pixel) / SIZE)[None, :]
    beta = np.radians(36.73 * (255.5 - pixel) / SIZE)[:, None]
    dz = -h1 * (1 - np.cos(alpha)) / np.tan(gamma)
    dy = dz * np.tan(theta + beta / 2)
    dx = (h2 + dy) * np.tan(alpha)
    # Of the beam inside the scanner.
    lead = (dz - h2) + np.hypot(dx, h2 + dy)
    length = (np.asarray(values, dtype=float) + _STANDOFF) * _STEP - lead
    # Published: x left, y up, z forward.
    x = -dx - length * np.sin(alpha)
    y = -dy - length * np.cos(alpha) * np.sin(beta)
    z = dz + length * np.cos(alpha) * np.cos(beta)
    return np.stack([x, y, z], axis=-1) * _PERCEPTRON_UNIT


def perceptron_range_image(values: ArrayLike) -> RangeImage:
    """Range image of (512, 512) Perceptron range values."""
    _check_size(values, 'Perceptron')
    return RangeImage.from_points(perceptron_points(values))


def _check_size(values: ArrayLike, sensor: str) -> None:
    """Raise SegcompError for an image of another size."""
    shape = np.shape(values)
    if shape != (SIZE, SIZE):
        raise SegcompError(f'{sensor} range images are {SIZE}x{SIZE}, not {shape}')
