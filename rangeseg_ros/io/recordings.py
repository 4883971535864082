"""Messages of recordings, whole or damaged: rosbag2 (mcap, sqlite3) and ROS 1 bags.

`rosbags` reads the indices of whole recordings, and what is not in chunks. The index at the end of
a file is missing after a crash of the recorder, on a full disk or after a broken download; of such
a file the records are read one after the other up to the damage.
"""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from functools import cache, partial
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rangeseg_ros.io.chunks import (
    Chunk,
    Connections,
    Lost,
    McapChannels,
    Record,
    mcap_chunk,
    merged,
    rosbag1_chunk,
    rosbag1_fields,
    rosbag1_message,
)
from rangeseg_ros.io.files import natural_order

# At both ends of mcap files.
_MCAP = b'\x89MCAP0\r\n'


class RecordingError(ValueError):
    """A file that is no recording, or of which nothing can be read."""


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
        kind = rosbag1.Reader if path.suffix == '.bag' else rosbag2.Reader
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
        return _deserialized(self.path, self.records(topics), topics)

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


class DamagedRecording:
    """What can be read from the front of a damaged recording.

    Attributes
    ----------
    types, counts : dict
        As of `Recording`, up to the damage.
    damage : str
        What ended the reading.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.types: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.damage = ''
        try:
            for record in _scanned(path):
                self.types[record.topic] = record.type
                self.counts[record.topic] += 1
        # Whatever is raised is the damage looked for.
        except Exception as error:
            self.damage = str(error) or type(error).__name__

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time and content of the messages on `topics`; raises where the damage is."""
        return _deserialized(self.path, _scanned(self.path), topics)

    def close(self) -> None:
        """Do nothing; no file stays open."""


def open_recording(path: Path) -> Recording | DamagedRecording:
    """Open a rosbag2 (directory, .mcap or .db3 file) or a ROS 1 .bag.

    Raises
    ------
    RecordingError
        Nothing can be read.
    OSError
        The file is missing or may not be read.
    """
    path.stat()
    try:
        return Recording(path)
    except PermissionError:
        raise
    # Readers meet damaged bytes with exceptions of every kind.
    except Exception as error:
        damaged = DamagedRecording(path)
        if not damaged.types:
            reason = damaged.damage or str(error)
            raise RecordingError(f'not a readable bag: {reason}') from None
        return damaged


@cache
def message_types(distribution: Stores) -> Typestore:
    """Message types of a ROS distribution; compiled once, at their first use."""
    return get_typestore(distribution)


def make_rosbags(kind: str, **fields: Any) -> Any:
    """Make a message of `rosbags`' Jazzy types, see `messages.Make`."""
    return message_types(Stores.ROS2_JAZZY).types[kind](**fields)


def _deserialized(
    path: Path, records: Iterator[Record | Lost], topics: Collection[str]
) -> Iterator[tuple[str, int, Any]]:
    """Messages on `topics`.

    A bag's own definitions are not used, so that odd ones elsewhere in it do no harm.
    """
    deserialize: Callable[[bytes, str], Any] = message_types(Stores.ROS2_JAZZY).deserialize_cdr
    if path.suffix == '.bag':
        deserialize = message_types(Stores.ROS1_NOETIC).deserialize_ros1
    for record in records:
        if record.topic not in topics:
            continue
        message: Any = record
        if isinstance(record, Record):
            try:
                message = deserialize(record.data, record.type)
            except Exception as error:
                message = Lost(record.topic, record.time, 1, f'damaged message: {error!r}')
        yield record.topic, record.time, message


def _unpacked(record: Record | Lost) -> Record | Lost:
    """Record of a bag whose messages are compressed one by one."""
    if isinstance(record, Lost):
        return record
    try:
        data = zstandard.ZstdDecompressor().decompress(record.data)
    except zstandard.ZstdError as error:
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
            header, data = _sized(file), _sized(file)
            records = rosbag1_chunk(rosbag1_fields(header), data, connections)
            return [record for record in records if record.topic in topics]

    for info in reader.chunk_infos:
        counts: Counter[str] = Counter()
        for key, count in info.connection_counts.items():
            if names.get(key) in topics:
                counts[names[key]] += count
        if counts:
            yield Chunk(info.start_time, counts, partial(read, info.pos))


def _scanned(path: Path) -> Iterator[Record]:
    """Records of a damaged recording from its front; raises where the damage is."""
    if path.is_dir():
        damage: Exception | None = None
        for part in sorted([*path.glob('*.mcap'), *path.glob('*.db3')], key=natural_order):
            try:
                yield from _scanned(part)
            except Exception as error:
                damage = damage or error
        if damage:
            raise damage
    elif path.suffix == '.mcap':
        yield from _scanned_mcap(path)
    elif path.suffix == '.db3':
        yield from _scanned_sqlite(path)
    elif path.suffix == '.bag':
        yield from _scanned_rosbag1(path)


def _scanned_mcap(path: Path) -> Iterator[Record]:
    channels = McapChannels()
    damage = ''
    with path.open('rb') as file:
        if file.read(8) != _MCAP:
            raise RecordingError('not an mcap file')
        while head := file.read(9):
            opcode, size = struct.unpack('<BQ', _whole(head, 9))
            if opcode in (2, 15):  # the messages end before
                file.seek(-8, 2)
                if file.read() != _MCAP:
                    damage = damage or 'file ends within its index'
                break
            body = file.read(min(size, path.stat().st_size))
            cut = len(body) < size
            if opcode == 6:
                # A bad chunk costs itself, one that is cut through its end.
                records = mcap_chunk(body, channels)
                try:
                    yield from records if cut else list(records)
                except Exception as error:
                    damage = damage or f'damaged chunk: {error}'
            elif opcode == 5 and not cut:
                yield channels.message(body)
            elif not cut:
                channels.define(opcode, body)
            if cut:
                raise EOFError('file ends within a record')
        else:
            raise EOFError(damage or 'file ends without an index')
    if damage:
        raise RecordingError(damage)


def _scanned_sqlite(path: Path) -> Iterator[Record]:
    uri = f'{path.absolute().as_uri()}?immutable=1'
    with closing(sqlite3.connect(uri, uri=True)) as database:
        # Without this, sqlite refuses any file shorter than its header says.
        database.execute('PRAGMA writable_schema = ON')
        topics = {row[0]: row[1:] for row in database.execute('SELECT id, name, type FROM topics')}
        # In the order of rowids the pages are read from the front, and no index is needed.
        rows = database.execute('SELECT topic_id, timestamp, data FROM messages ORDER BY id')
        for topic, time, data in rows:
            name, kind = topics[topic]
            yield Record(name, kind, time, data)


def _scanned_rosbag1(path: Path) -> Iterator[Record]:
    connections: Connections = {}
    damage = ''
    with path.open('rb') as file:
        file.readline()  # '#ROSBAG V2.0'
        while head := file.read(4):
            fields = rosbag1_fields(_whole(file.read(size := _size(head)), size))
            data = file.read(size := _size(file.read(4)))
            if fields[b'op'] == b'\x05':
                records = rosbag1_chunk(fields, data, connections)
                try:
                    yield from records if len(data) < size else list(records)
                except Exception as error:
                    damage = damage or f'damaged chunk: {error}'
            else:
                yield from rosbag1_message(fields, _whole(data, size), connections)
            _whole(data, size)
    raise EOFError(damage or 'file ends without an index')


def _sized(file: BinaryIO) -> bytes:
    size = _size(file.read(4))
    return _whole(file.read(size), size)


def _size(data: bytes) -> int:
    return int(struct.unpack('<I', _whole(data, 4))[0])


def _whole(data: bytes, size: int) -> bytes:
    if len(data) < size:
        raise EOFError('file ends within a record')
    return data
