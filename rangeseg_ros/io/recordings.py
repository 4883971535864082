"""Messages of recordings, whole or damaged: rosbag2 (mcap, sqlite3) and ROS 1 bags.

`rosbags` reads whole recordings. It needs the index at the end of the file, which is missing
after a crash of the recorder, on a full disk or after a broken download; of such a file the
records are read one after the other up to the damage.
"""

from __future__ import annotations

import bz2
import io
import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rangeseg_ros.io.files import natural_order


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
    damage : str
        Empty.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        kind = rosbag1.Reader if path.suffix == '.bag' else rosbag2.Reader
        self._reader: rosbag1.Reader | rosbag2.Reader = kind(path)
        self._reader.open()
        self.types: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        self.damage = ''
        for connection in self._reader.connections:
            name = connection.topic
            self.types[name] = connection.msgtype
            self.counts[name] = self.counts.get(name, 0) + connection.msgcount

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time and content of the messages on `topics`, in the order of their times."""
        wanted = [c for c in self._reader.connections if c.topic in topics]
        deserialize = _deserializer(self.path)
        for connection, time, data in self._reader.messages(wanted):
            yield connection.topic, time, deserialize(data, connection.msgtype)

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
        self.counts: dict[str, int] = {}
        self.damage = ''
        try:
            for record in _records(path):
                self.types[record.topic] = record.type
                self.counts[record.topic] = self.counts.get(record.topic, 0) + 1
        # Whatever is raised is the damage looked for.
        except Exception as error:
            self.damage = str(error) or type(error).__name__

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time and content of the messages on `topics`; raises where the damage is."""
        deserialize = _deserializer(self.path)
        for record in _records(self.path):
            if record.topic in topics:
                yield record.topic, record.time, deserialize(record.data, record.type)

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
            raise RecordingError(f'not a readable bag: {error}') from None
        return damaged


def _deserializer(path: Path) -> Callable[[bytes, str], Any]:
    """Decoder of messages of the standard packages.

    A bag's own definitions are not used, so that odd ones elsewhere in it do no harm.
    """
    if path.suffix == '.bag':
        return message_types(Stores.ROS1_NOETIC).deserialize_ros1
    return message_types(Stores.ROS2_JAZZY).deserialize_cdr


@cache
def message_types(distribution: Stores) -> Typestore:
    """Message types of a ROS distribution; compiled once, at their first use."""
    return get_typestore(distribution)


def make_rosbags(kind: str, **fields: Any) -> Any:
    """Make a message of `rosbags`' Jazzy types, see `messages.Make`."""
    return message_types(Stores.ROS2_JAZZY).types[kind](**fields)


class _Record(NamedTuple):
    topic: str
    type: str
    time: int
    data: bytes


def _records(path: Path) -> Iterator[_Record]:
    if path.is_dir():
        for part in sorted([*path.glob('*.mcap'), *path.glob('*.db3')], key=natural_order):
            yield from _records(part)
    elif path.suffix == '.mcap':
        yield from _mcap_records(path)
    elif path.suffix == '.db3':
        yield from _sqlite_records(path)
    elif path.suffix == '.bag':
        with path.open('rb') as file:
            file.readline()  # '#ROSBAG V2.0'
            yield from _rosbag1_records(file, {})
        raise EOFError('file ends without an index')


def _mcap_records(path: Path) -> Iterator[_Record]:
    schemas: dict[int, str] = {}
    channels: dict[int, Channel] = {}
    with path.open('rb') as file:
        try:
            for record in StreamReader(file, record_size_limit=path.stat().st_size).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    kind = schemas[channel.schema_id]
                    yield _Record(channel.topic, kind, record.log_time, record.data)
        except EndOfFile:
            raise EOFError('file ends within a record') from None


def _sqlite_records(path: Path) -> Iterator[_Record]:
    uri = f'{path.absolute().as_uri()}?immutable=1'
    with closing(sqlite3.connect(uri, uri=True)) as database:
        # Without this, sqlite refuses any file shorter than its header says.
        database.execute('PRAGMA writable_schema = ON')
        topics = {row[0]: row[1:] for row in database.execute('SELECT id, name, type FROM topics')}
        # In the order of rowids the pages are read from the front, and no index is needed.
        rows = database.execute('SELECT topic_id, timestamp, data FROM messages ORDER BY id')
        for topic, time, data in rows:
            name, kind = topics[topic]
            yield _Record(name, kind, time, data)


def _rosbag1_records(
    file: BinaryIO, connections: dict[bytes, tuple[str, str]]
) -> Iterator[_Record]:
    """Records of the ROS 1 bag format 2.0 (wiki.ros.org/Bags/Format/2.0) or of one chunk of it."""
    while size := file.read(4):
        fields = dict(_rosbag1_fields(_exactly(file, struct.unpack('<I', size)[0])))
        data = _exactly(file, struct.unpack('<I', _exactly(file, 4))[0])
        match fields[b'op']:
            case b'\x05':
                unpack = {b'none': bytes, b'bz2': bz2.decompress, b'lz4': lz4.frame.decompress}
                chunk = unpack[fields[b'compression']](data)
                yield from _rosbag1_records(io.BytesIO(chunk), connections)
            case b'\x07':
                package, _, name = dict(_rosbag1_fields(data))[b'type'].decode().partition('/')
                connections[fields[b'conn']] = (fields[b'topic'].decode(), f'{package}/msg/{name}')
            case b'\x02':
                seconds, nanoseconds = struct.unpack('<II', fields[b'time'])
                time = seconds * 10**9 + nanoseconds
                yield _Record(*connections[fields[b'conn']], time, data)


def _rosbag1_fields(header: bytes) -> Iterator[tuple[bytes, bytes]]:
    position = 0
    while position < len(header):
        (size,) = struct.unpack_from('<I', header, position)
        name, _, value = header[position + 4 : position + 4 + size].partition(b'=')
        yield name, value
        position += 4 + size


def _exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError('file ends within a record')
    return data
