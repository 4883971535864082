"""Bags written with the checksums that tell damaged chunks from whole ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zlib import crc32

from rosbags import rosbag2
from rosbags.rosbag2.storage_mcap import McapWriter

# Of the checksum in the record of a chunk: opcode, length, two times and the size come first.
_CRC_OFFSET = 1 + 8 + 8 + 8 + 8


class _CheckedMcapWriter(McapWriter):
    """Writes the checksum of every chunk, for which rosbags leaves a 0."""

    def close_chunk(self) -> None:
        crc, start = crc32(self.chunk.bio.getbuffer()), self.bio.tell()
        super().close_chunk()
        end = self.bio.tell()
        self.bio.seek(start + _CRC_OFFSET)
        self.bio.write(crc.to_bytes(4, 'little'))
        self.bio.seek(end)


class BagWriter(rosbag2.Writer):
    """Writer of a rosbag2 (mcap, version 9).

    Parameters
    ----------
    path : Path
        Directory to make.
    compressed : bool
        Compress the chunks with zstd.
    """

    STORAGE_PLUGINS: Mapping[rosbag2.StoragePlugin, Any] = {
        rosbag2.StoragePlugin.MCAP: _CheckedMcapWriter
    }

    def __init__(self, path: Path, compressed: bool = False) -> None:
        super().__init__(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        if compressed:
            self.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
