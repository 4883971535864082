"""Files of data sets, made by hand."""

import struct


def raster(image, magic=0x59A66A95, width=None, depth=8, kind=1, colours=0):
    """Bytes of an 8-bit raster of an image (H, W) uint8, or of one whose header says otherwise."""
    height, columns = image.shape
    words = magic, columns if width is None else width, height, depth, image.size, kind, 0, colours
    return struct.pack('>8I', *words) + image.tobytes()
