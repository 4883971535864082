"""Recordings, whole or damaged: rosbag2 (mcap, sqlite3) and ROS 1 bags.

`rosbags` reads the indices of whole recordings; their messages are read by `bag_formats`.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import zstandard
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader

from rangeseg_ros.io.bag_formats import (
    Channels,
    DamageError,
    Lost,
    Record,
    check_expansion,
    file_records,
)
from rangeseg_ros.io.files import natural_order
from rangeseg_ros.io.message_types import deserialized, is_rosbag1
from rangeseg_ros.io.yaml_files import LARGEST


class BagError(ValueError):
    """A recording that cannot be read or written, or that lacks depth images or their camera."""


class RecordingError(ValueError):
    """A file that is no recording, or of which nothing can be read."""


class _McapReader(McapReader):
    """Leaves files without an index to `bag_formats`, which unpacks no more than it may."""

    def meta_scan(self) -> None:
        raise RecordingError('no index')


class _DirectoryReader(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {**DirectoryReader.STORAGE_PLUGINS, 'mcap': _McapReader}


class _Reader(rosbag2.Reader):
    STORAGE_PLUGINS: Mapping[str, Any] = {
        **rosbag2.Reader.STORAGE_PLUGINS,
        'dir': _DirectoryReader,
        '.mcap': _McapReader,
    }


class Recording:
    """A rosbag2 (directory, .mcap or .db3 file) or a ROS 1 .bag.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    types : dict of str
        Message type of each topic, in the ROS 2 form.
    counts : dict of int
        Messages of each topic, of a recording without an index those that can be read.
    connections : list of rosbags.interfaces.Connection
        The topics with all that is recorded of them; empty without an index.
    damage : str
        What ends the reading of a recording without an index; empty when nothing does.

    Raises
    ------
    RecordingError
        Nothing can be read.
    OSError
        The file is missing or may not be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.types: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.connections: list[Any] = []
        self.damage = ''
        check_files(path)
        self._reader: Any = rosbag1.Reader(path) if is_rosbag1(path) else None
        try:
            self._reader = self._reader or _Reader(path)
            self._reader.open()
        except PermissionError:
            raise
        # Readers meet damaged bytes with exceptions of every kind.
        except Exception as error:
            self._reader = None
            self._count()
            if not self.types:
                reason = self.damage or why_unreadable(path, error)
                raise RecordingError(f'not a readable bag: {reason}') from None
            return
        self.connections = list(self._reader.connections)
        for connection in self.connections:
            self.types[connection.topic] = connection.msgtype
            self.counts[connection.topic] += connection.msgcount

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time and content of the messages on `topics`.

        Of a whole recording in the order of their times; `Lost` is the content of what cannot be
        read. Raises DamageError at the end of a recording without an index that is damaged.
        """
        return deserialized(self.path, self.records(topics), topics)

    def records(self, topics: Collection[str]) -> Iterator[Record | Lost]:
        """Messages on `topics` as they are stored, else as `messages`."""
        damage = ''
        missing = Counter({topic: self.counts[topic] for topic in topics})
        time = 0
        for path, channels in self._files():
            try:
                for record in file_records(path, channels, topics):
                    if record.topic in topics:
                        missing[record.topic] -= 1
                        time = record.time
                        yield self._unpacked(record)
            except DamageError as error:
                damage = damage or str(error)
        if damage and not self._reader:
            raise DamageError(damage)
        for topic, count in missing.items():
            if damage and count > 0:
                yield Lost(topic, time, count, damage)

    def close(self) -> None:
        """Close the files."""
        if self._reader:
            self._reader.close()

    def _files(self) -> list[tuple[Path, Channels]]:
        """Files that hold the messages, and their topics by the index."""
        if self._reader is None:
            if not self.path.is_dir():
                return [(self.path, {})]
            parts = [*self.path.glob('*.mcap'), *self.path.glob('*.db3')]
            return [(part, {}) for part in sorted(parts, key=natural_order)]
        storage = getattr(self._reader, 'storage', self._reader)
        return [
            (Path(part.path), {c.id: (c.topic, c.msgtype) for c in part.connections})
            for part in getattr(storage, 'storages', [storage])
        ]

    def _unpacked(self, record: Record) -> Record | Lost:
        """Record of a bag whose messages may be compressed one by one."""
        if getattr(self._reader, 'compression_mode', None) != 'message':
            return record
        return unpacked(record)

    def _count(self) -> None:
        for path, _ in self._files():
            try:
                for record in file_records(path, {}):
                    self.types[record.topic] = record.type
                    self.counts[record.topic] += 1
            except DamageError as error:
                self.damage = self.damage or str(error)


def unpacked(record: Record) -> Record | Lost:
    """Record of a message that is compressed by itself (zstd)."""
    try:
        check_expansion(len(record.data), zstandard.frame_content_size(record.data))
        data = zstandard.ZstdDecompressor().decompress(record.data)
    except (DamageError, zstandard.ZstdError) as error:
        return Lost(record.topic, record.time, 1, f'damaged message: {error}')
    return record._replace(data=data)


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
