"""Depth images, label images and pictures in files."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Mask
from rangeseg_ros.io.files import FileError, read_bytes, replacing
from rangeseg_ros.messages.images import shape_and_pages


def read_depth(path: Path, shape: tuple[int, int] | None = None) -> NDArray:
    """Depth image (H, W) of a PNG, PGM, PFM or TIFF of 8 or 16 bits or floats, in its unit.

    FileError: another kind of image or, before it is decoded, another size than `shape` (H, W).
    """
    image = _read(path, shape)
    if image.ndim != 2:
        raise FileError(
            f'{path}: depth image must have one channel, not {image.shape[2]} (colour?)'
        )
    return image


def read_labels(path: Path) -> NDArray[np.uint16]:
    """Label image (H, W) of a PNG or TIFF of 8 or 16 bits and one channel; else FileError."""
    image = _read(path)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise FileError(
            f'{path}: label image must have one channel of 8 or 16 bits, '
            f'not {channels} of {image.dtype}'
        )
    return image.astype(np.uint16, copy=False)


def read_mask(path: Path) -> Mask:
    """Mask (H, W) of an image of any type: True where a channel is not 0.

    Of four channels, the last one is opacity.
    """
    image = _read(path)
    if image.ndim == 2:
        return image != 0
    mask: Mask = (image[..., :3] != 0).any(axis=2)
    return mask & (image[..., 3] != 0) if image.shape[2] == 4 else mask


def write_image(path: Path, image: NDArray) -> None:
    """Write (H, W) uint8, uint16 or float32, or (H, W, 3) R, G, B: PNG, or TIFF by its suffix."""
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    # Some versions of OpenCV round three channels of floats for TIFF (LogLuv); LZW (5) does not.
    lossless = [cv2.IMWRITE_TIFF_COMPRESSION, 5] if path.suffix.startswith('.tif') else []
    _, data = cv2.imencode(path.suffix, image, lossless)
    with replacing(path) as partial:
        partial.write_bytes(data.tobytes())


def _read(path: Path, shape: tuple[int, int] | None = None) -> NDArray:
    data = read_bytes(path)
    kinds = (shape_and_pages(data, kind) for kind in ('PNG', 'TIFF', 'PPM'))
    size, pages = next((found for found in kinds if found[0]), (None, 0))
    if size and shape and size != shape:
        raise FileError(
            f'{path}: depth image is {size[1]}x{size[0]}, its camera {shape[1]}x{shape[0]}'
        )
    try:
        pixels = np.frombuffer(data, np.uint8)
        image = cv2.imdecode(pixels, cv2.IMREAD_UNCHANGED) if size else None
    except cv2.error:
        image = None
    if image is None:
        raise FileError(f'{path}: no readable PNG, PGM, PFM, or TIFF of 8 or 16 bits or float32')
    if pages > 1:
        warnings.warn(f'{path}: only the first of {pages} pages is read', stacklevel=3)
    return image
