"""Recordings, whole or damaged: rosbag2 (mcap, sqlite3) and ROS 1 bags.

`rosbags` reads the indices of whole recordings, and what is not in chunks.
"""

from __future__ import annotations

import shutil
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import zstandard
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader

from rangeseg_ros.io.chunks import (
    Chunk,
    ChunkError,
    Lost,
    McapChannels,
    Record,
    check_expansion,
    mcap_chunk,
    mcap_chunk_sizes,
    merged,
    rosbag1_chunk,
    rosbag1_fields,
    rosbag1_part,
    whole,
)
from rangeseg_ros.io.damaged_recordings import DamagedRecording
from rangeseg_ros.io.message_types import deserialized
from rangeseg_ros.io.yaml_files import LARGEST


class BagError(ValueError):
    """A recording that cannot be read or written, or that lacks depth images or their camera."""


class RecordingError(ValueError):
    """A file that is no recording, or of which nothing can be read."""


class _McapReader(McapReader):
    """Reads files without an index only where their chunks can be unpacked."""

    def meta_scan(self) -> None:
        with self.path.open('rb') as file:
            place = self.data_start
            while place < self.data_end:
                file.seek(place)
                opcode, size = struct.unpack('<BQ', whole(file.read(9), 9))
                if opcode == 6:
                    check_expansion(*mcap_chunk_sizes(file.read(64)))
                place += 9 + size
        super().meta_scan()


class _DirectoryReader(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {**DirectoryReader.STORAGE_PLUGINS, 'mcap': _McapReader}


class _Reader(rosbag2.Reader):
    STORAGE_PLUGINS: Mapping[str, Any] = {
        **rosbag2.Reader.STORAGE_PLUGINS,
        'dir': _DirectoryReader,
        '.mcap': _McapReader,
    }


class Recording:
    """A whole recording.

    Attributes
    ----------
    types : dict of str
        Message type of each topic, in the ROS 2 form.
    counts : dict of int
        Messages of each topic.
    connections : list of rosbags.interfaces.Connection
        The topics with all that is recorded of them.
    damage : str
        Empty.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        kind = rosbag1.Reader if path.suffix == '.bag' else _Reader
        self._reader: Any = kind(path)
        self._reader.open()
        self.types: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.damage = ''
        self.connections = list(self._reader.connections)
        for connection in self.connections:
            self.types[connection.topic] = connection.msgtype
            self.counts[connection.topic] += connection.msgcount

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time and content of the messages on `topics`, in the order of their times.

        `Lost` is the content of what cannot be read.
        """
        return deserialized(self.path, self.records(topics), topics)

    def records(self, topics: Collection[str]) -> Iterator[Record | Lost]:
        """Messages on `topics` as they are stored, in the order of their times."""
        if self.path.suffix == '.bag':
            yield from merged(list(_rosbag1_chunks(self._reader, topics)))
            return
        storage = self._reader.storage
        packed = False
        if isinstance(storage, DirectoryReader):
            packed = storage.metadata.compression_mode == 'message'
        for part in storage.storages if isinstance(storage, DirectoryReader) else [storage]:
            records = _storage_records(part, topics)
            yield from map(_unpacked, records) if packed else records

    def close(self) -> None:
        """Close the files."""
        self._reader.close()


def open_recording(path: Path) -> Recording | DamagedRecording:
    """Open a rosbag2 (directory, .mcap or .db3 file) or a ROS 1 .bag.

    Raises
    ------
    RecordingError
        Nothing can be read.
    OSError
        The file is missing or may not be read.
    """
    check_files(path)
    try:
        return Recording(path)
    except (PermissionError, RecordingError):
        raise
    # Readers meet damaged bytes with exceptions of every kind.
    except Exception as error:
        damaged = DamagedRecording(path)
        if not damaged.types:
            reason = damaged.damage or why_unreadable(path, error)
            raise RecordingError(f'not a readable bag: {reason}') from None
        return damaged


def check_files(path: Path) -> None:
    """Raise RecordingError for what would never be read to its end, OSError where nothing is."""
    path.stat()
    for part in path.iterdir() if path.is_dir() else [path]:
        if part.exists() and not (part.is_file() or part.is_dir()):
            raise RecordingError(f'{part.name}: not a regular file')
    metadata = path / 'metadata.yaml'
    if metadata.is_file() and metadata.stat().st_size > LARGEST:
        raise RecordingError('metadata.yaml: too large for such a file')
    for packed in path.glob('*.zstd') if path.is_dir() else ():
        _check_room(packed)


def _check_room(packed: Path) -> None:
    """Raise RecordingError where a whole compressed file, which is unpacked, has no room."""
    with packed.open('rb') as file, suppress(zstandard.ZstdError):
        size = zstandard.frame_content_size(file.read(18))
        if size > shutil.disk_usage(gettempdir()).free:
            raise RecordingError(f'{packed.name}: no room for {size} bytes in {gettempdir()}')


def why_unreadable(path: Path, error: Exception) -> str:
    """What the reader of `rosbags` stumbled over; it calls the metadata by the bag's name."""
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        return 'the folder has no metadata.yaml'
    return str(error)


def _unpacked(record: Record | Lost) -> Record | Lost:
    """Record of a bag whose messages are compressed one by one."""
    if isinstance(record, Lost):
        return record
    try:
        check_expansion(len(record.data), zstandard.frame_content_size(record.data))
        data = zstandard.ZstdDecompressor().decompress(record.data)
    except (ChunkError, zstandard.ZstdError) as error:
        return Lost(record.topic, record.time, 1, f'damaged message: {error}')
    return record._replace(data=data)


def _storage_records(storage: Any, topics: Collection[str]) -> Iterator[Record | Lost]:
    """Records of one file of a whole rosbag2."""
    if isinstance(storage, McapReader) and storage.chunks:
        yield from merged(list(_mcap_chunks(storage, topics)))
        return
    wanted = [connection for connection in storage.connections if connection.topic in topics]
    for connection, time, data in storage.messages(wanted) if wanted else ():
        yield Record(connection.topic, connection.msgtype, time, data)


def _mcap_chunks(storage: McapReader, topics: Collection[str]) -> Iterator[Chunk]:
    """Chunks of a whole file that hold any of the topics."""
    channels = McapChannels()
    channels.channels = {key: (c.topic, c.schema) for key, c in storage.channels.items()}

    def read(offset: int, length: int) -> list[Record]:
        with storage.path.open('rb') as file:
            file.seek(offset + 9)
            records = mcap_chunk(file.read(length - 9), channels)
            return [record for record in records if record.topic in topics]

    for info in storage.chunks:
        counts: Counter[str] = Counter()
        for key, count in info.channel_count.items():
            if key in storage.channels and storage.channels[key].topic in topics:
                counts[storage.channels[key].topic] += count
        if counts:
            start, size = info.chunk_start_offset, info.chunk_length
            yield Chunk(info.message_start_time, counts, partial(read, start, size))


def _rosbag1_chunks(reader: rosbag1.Reader, topics: Collection[str]) -> Iterator[Chunk]:
    """Chunks of a whole ROS 1 bag that hold any of the topics."""
    names = {connection.id: connection.topic for connection in reader.connections}
    connections = {struct.pack('<I', c.id): (c.topic, c.msgtype) for c in reader.connections}

    def read(position: int) -> list[Record]:
        with reader.path.open('rb') as file:
            file.seek(position)
            header, data = rosbag1_part(file), rosbag1_part(file)
            records = rosbag1_chunk(rosbag1_fields(header), data, connections)
            return [record for record in records if record.topic in topics]

    for info in reader.chunk_infos:
        counts: Counter[str] = Counter()
        for key, count in info.connection_counts.items():
            if names.get(key) in topics:
                counts[names[key]] += count
        if counts:
            yield Chunk(info.start_time, counts, partial(read, info.pos))
