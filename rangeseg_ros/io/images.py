"""Depth images, label images and pictures in files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.io.files import replacing


class ImageFileError(ValueError):
    """A file that is no image of the kind asked for."""


def read_depth(path: Path) -> NDArray:
    """Read a depth image: 16-bit PNG or TIFF, or floating-point TIFF.

    Returns
    -------
    (H, W) uint16 or floating point, in the unit of the file.

    Raises
    ------
    ImageFileError
        A missing or unreadable file, several channels, or another type such as 8 bits.
    """
    image = _read(path)
    if image.ndim != 2:
        raise ImageFileError(
            f'{path}: depth image must have one channel, not {image.shape[2]} (colour?)'
        )
    if image.dtype != np.uint16 and image.dtype.kind != 'f':
        raise ImageFileError(f'{path}: depth image must be 16-bit or float, not {image.dtype}')
    return image


def read_labels(path: Path) -> NDArray[np.uint16]:
    """Read a label image: PNG or TIFF of 8 or 16 bits and one channel.

    Returns
    -------
    (H, W) uint16

    Raises
    ------
    ImageFileError
        A missing or unreadable file, several channels, or another type.
    """
    image = _read(path)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise ImageFileError(
            f'{path}: label image must have one channel of 8 or 16 bits, '
            f'not {channels} of {image.dtype}'
        )
    return image.astype(np.uint16, copy=False)


def write_image(path: Path, image: NDArray) -> None:
    """Write a PNG or TIFF, by the suffix of `path`.

    Parameters
    ----------
    path : Path
    image : (H, W) uint8, uint16 or float32, or (H, W, 3) uint8 or float32
        Three channels are R, G, B; floats are for TIFF.
    """
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(path.suffix, image)
    with replacing(path) as partial:
        partial.write_bytes(data.tobytes())


def _read(path: Path) -> NDArray:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ImageFileError(f'{path}: {error.strerror}') from None
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise ImageFileError(f'{path}: not a readable image')
    return image
