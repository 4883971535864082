"""Images of messages: sensor_msgs/Image and compressedDepth in, sensor_msgs/Image out."""

from __future__ import annotations

import io
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.messages.make import IMAGE, Make, MessageError, elements

# REP 118: millimetres as unsigned integers, or metres as floats.
PIXEL_TYPES = {'16UC1': np.uint16, 'mono16': np.uint16, '32FC1': np.float32}

# compressed_depth_image_transport: ConfigHeader {int32 format; float32 a, b}, then the PNG.
_HEADER = struct.Struct('<iff')


def depth_from_message(
    message: Any, shape: tuple[int, int] | None = None
) -> NDArray[np.uint16] | Singles:
    """Depth image (H, W) of a sensor_msgs/Image, or a CompressedImage of compressedDepth.

    uint16 in millimetres or float32 in metres, native byte order; a view of the data where that is
    possible, so not to be written to. MessageError: no depth image, a damaged one or, before it
    is decoded, a compressed one of another size than `shape` (H, W).
    """
    return _compressed(message, shape) if hasattr(message, 'format') else _plain(message)


def _plain(message: Any) -> NDArray[np.uint16] | Singles:
    """Image whose rows may be padded, the last one not."""
    height, width, encoding = message.height, message.width, message.encoding
    if encoding not in PIXEL_TYPES:
        raise MessageError(
            f'encoding {encoding!r} is no depth image; known: {", ".join(PIXEL_TYPES)}'
        )
    if height < 1 or width < 1:
        raise MessageError(f'depth image is empty ({width}x{height})')
    kind = np.dtype(PIXEL_TYPES[encoding]).newbyteorder('>' if message.is_bigendian else '<')
    return np.ascontiguousarray(elements(message, kind, message.step, encoding))


def _compressed(message: Any, shape: tuple[int, int] | None) -> NDArray[np.uint16] | Singles:
    """Image of compressed_depth_image_transport: a 12-byte header and a 16-bit PNG.

    32FC1 is quantised in inverse depth: depth = a / (value - b), 0 invalid, a and b in the header.
    """
    encoding, _, compression = (part.strip() for part in message.format.partition(';'))
    # Older publishers do not name the codec; it was always PNG.
    known = ('compressedDepth', 'compressedDepth png')
    if encoding not in PIXEL_TYPES or compression not in known:
        formats = ', '.join(f'{name}; {known[1]}' for name in PIXEL_TYPES)
        raise MessageError(f'format {message.format!r} is no known depth image; known: {formats}')
    raw = np.frombuffer(message.data, np.uint8)
    if raw.size <= _HEADER.size:
        raise MessageError(f'compressed depth image of {raw.size} bytes has no PNG')
    _, a, b = _HEADER.unpack(raw[: _HEADER.size].tobytes())
    png = raw[_HEADER.size :]
    size, _ = shape_and_pages(png.tobytes(), 'PNG')
    if size and shape and size != shape:
        raise MessageError(
            f'depth image is {size[1]}x{size[0]}, its camera_info {shape[1]}x{shape[0]}'
        )
    try:
        image = cv2.imdecode(png, cv2.IMREAD_UNCHANGED) if size else None
    except cv2.error:
        image = None
    if image is None:
        raise MessageError('compressed depth image holds no readable PNG')
    if image.ndim != 2 or image.dtype != np.uint16:
        raise MessageError(
            f'compressed depth image must be a 16-bit PNG of one channel, not {image.dtype} of '
            f'shape {image.shape}'
        )
    if encoding != '32FC1':
        return image.view(np.uint16)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        depth = np.float32(a) / (image.astype(np.float32) - np.float32(b))
    depth[(image == 0) | ~(depth > 0)] = np.nan
    return depth


def shape_and_pages(data: bytes, kind: str) -> tuple[tuple[int, int] | None, int]:
    """(H, W) and pages of a PNG, of a PGM or PFM (PPM), or of the first page of a TIFF.

    None for others, and for a PNG whose checksums say that it is damaged. Found before decoding:
    OpenCV would take gigabytes for a damaged length, and libpng complain on stderr.
    """
    try:
        with Image.open(io.BytesIO(data), formats=[kind]) as file:
            found = file.size[::-1], getattr(file, 'n_frames', 1)
            if kind == 'PNG':
                file.verify()
            return found
    # Damaged bytes are met with exceptions of every kind.
    except Exception:
        return None, 0


def image_message(make: Make, header: Any, pixels: NDArray, encoding: str) -> Any:
    """sensor_msgs/Image of an array (H, W) or (H, W, channels)."""
    rows = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder('<'))
    return make(
        IMAGE,
        header=header,
        height=rows.shape[0],
        width=rows.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.strides[0],
        data=rows.reshape(-1).view(np.uint8),
    )
