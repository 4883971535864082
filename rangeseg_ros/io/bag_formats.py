"""Files of recordings, read record by record: mcap, sqlite3 and the ROS 1 bag format 2.0.

`rosbags` reads whole files only, and unpacks whatever a chunk declares. Here damage costs what is
damaged, and a chunk is unpacked within the size it declares (mcap.dev/spec,
wiki.ros.org/Bags/Format/2.0).
"""

from __future__ import annotations

import bz2
import heapq
import io
import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import lz4.frame
import zstandard

_MCAP = b'\x89MCAP0\r\n'  # at both ends of a file
_PIECE = 2**20
# What is compressed may become so many bytes, 16 times the largest chunks that recorders make by
# their presets, and more only where more is stored.
_LARGEST, _EXPANSION = 2**26, 16
_STREAMS: dict[str, Callable[[BinaryIO], Any]] = {
    '': lambda file: file,
    'none': lambda file: file,
    'zstd': lambda file: zstandard.ZstdDecompressor().stream_reader(file),
    'lz4': lz4.frame.open,
    'bz2': bz2.open,
}

Channels = dict[int, tuple[str, str]]
"""Topic and message type by the number that messages have in a file."""


class DamageError(ValueError):
    """Bytes of a recording that are not what they should be."""


class Record(NamedTuple):
    """A message as it is stored; `time` is that of its recording, nanoseconds."""

    topic: str
    type: str
    time: int
    data: bytes


class Lost(NamedTuple):
    """So many messages of a topic that cannot be read."""

    topic: str
    time: int
    messages: int
    reason: str


@dataclass
class Part:
    """Messages that are stored together: a chunk, or one by itself.

    Attributes
    ----------
    start : int
        Time of its first message, nanoseconds; 0 where the file does not say.
    read : callable
        Gives the records.
    channels : set of int
        Whose messages it holds; empty where the file does not say.
    """

    start: int
    read: Callable[[], Iterator[Record]]
    channels: set[int] = field(default_factory=set)


def file_records(
    path: Path, channels: Channels, topics: Collection[str] | None = None
) -> Iterator[Record]:
    """Records of a file, at least those on `topics`; what is damaged is left out.

    Parameters
    ----------
    path : Path
        .mcap, .db3 or .bag file.
    channels : Channels
        Of the index of a whole file: then only chunks that hold any of the topics are read, those
        of mcap in the order of their times. Of a damaged file {}: it is read from the front.
    topics : collection of str, optional

    Raises
    ------
    DamageError
        At the end, when anything was left out; the message is the first damage.
    """
    damage: list[str] = []
    parts, end = [], ''
    wanted = {number for number, (topic, _) in channels.items() if topic in (topics or ())}
    list_parts = _PARTS.get(path.suffix)
    if list_parts is None:
        raise DamageError('not a .mcap, .db3 or .bag file')
    try:
        for part in list_parts(path, dict(channels)):
            parts.append(part)
    # Damaged bytes are met with exceptions of every kind, of decompressors and of databases.
    except Exception as error:
        end = str(error) or type(error).__name__

    def opened(part: Part) -> Iterator[tuple[int, Record | None]]:
        # First its time alone: a chunk is read when that has come.
        yield part.start, None
        try:
            for record in part.read():
                yield record.time, record
        except Exception as error:
            damage.append(str(error) or type(error).__name__)

    chosen = [p for p in parts if not wanted or not p.channels or p.channels & wanted]
    streams = map(opened, chosen)
    if channels and path.suffix == '.mcap':
        for _, record in heapq.merge(*streams, key=itemgetter(0)):
            if record:
                yield record
    else:
        for stream in streams:
            yield from (record for _, record in stream if record)
    if damage or end:
        raise DamageError((*damage, end)[0])


def check_expansion(stored: int, size: int) -> None:
    """Raise DamageError where compressed bytes declare to become far more."""
    if size > max(_LARGEST, _EXPANSION * stored):
        raise DamageError(f'{stored} compressed bytes declare to be {size}')


def unpack(compression: str, data: bytes, size: int, crc: int = 0) -> tuple[bytes, str]:
    """Content of a chunk as far as it can be had, and what is wrong with it.

    Parameters
    ----------
    compression : str
        '', 'none', 'zstd', 'lz4' or 'bz2'.
    data : bytes
        As stored, perhaps cut off.
    size : int
        What the chunk declares to hold, bytes; no more is unpacked.
    crc : int
        Checksum of the content; 0 = none.
    """
    if compression not in _STREAMS:
        return b'', f'unknown compression {compression!r}'
    content = bytearray()
    try:
        if compression not in ('', 'none'):
            check_expansion(len(data), size)
        stream = _STREAMS[compression](io.BytesIO(data))
        while piece := stream.read(min(_PIECE, size + 1 - len(content))):
            content += piece
    except Exception as error:
        return bytes(content), str(error)
    if len(content) != size:
        return bytes(content[:size]), 'it is not as large as it declares'
    wrong = crc and crc != crc32(content)
    return bytes(content), 'its checksum does not match' if wrong else ''


def _chunk_records(
    content: bytes, problem: str, cut: bool, parse: Callable[[bytes], Iterator[Record]]
) -> Iterator[Record]:
    """Records of a chunk: all or, where the file ends within it, those before the end."""
    if cut:
        with suppress(Exception):
            yield from parse(content)
        raise DamageError('file ends within a record')
    try:
        if not problem:
            yield from sorted(parse(content), key=attrgetter('time'))
    except Exception as error:
        problem = str(error) or type(error).__name__
    if problem:
        raise DamageError(f'damaged chunk: {problem}')


def _mcap_parts(path: Path, channels: Channels) -> Iterator[Part]:
    size_of_file = path.stat().st_size
    schemas: dict[int, str] = {}
    chunk: Part | None = None
    with path.open('rb') as file:
        if file.read(8) != _MCAP:
            raise DamageError('not an mcap file')
        while head := file.read(9):
            opcode, size = struct.unpack('<BQ', _whole(head, 9))
            place = file.tell()
            cut = place + size > size_of_file
            if opcode in (2, 15):  # the messages end before
                file.seek(-8, 2)
                if file.read() != _MCAP:
                    raise DamageError('file ends within its index')
                return
            if opcode == 6:
                start = int(struct.unpack('<Q', _whole(file.read(8), 8))[0])
                read = partial(_mcap_chunk, path, place, min(size, size_of_file - place), cut)
                chunk = Part(start, partial(read, schemas, channels))
                yield chunk
            elif opcode == 7 and chunk and not cut:  # what the chunk before holds
                chunk.channels |= set(struct.unpack('<H', file.read(2)))
            elif opcode in (3, 4, 5) and not cut:
                body = file.read(size)
                for record in _mcap_record(opcode, body, schemas, channels):
                    yield Part(record.time, partial(iter, [record]))
            if cut:
                raise DamageError('file ends within a record')
            file.seek(place + size)
    raise DamageError('file ends without an index')


def _mcap_chunk(
    path: Path, place: int, size: int, cut: bool, schemas: dict[int, str], channels: Channels
) -> Iterator[Record]:
    with path.open('rb') as file:
        file.seek(place)
        body = file.read(size)
    _, _, declared, crc = struct.unpack_from('<QQQI', body)
    compression = _string(body, 28)
    start = 28 + 4 + len(compression) + 8
    (stored,) = struct.unpack_from('<Q', body, start - 8)

    def parse(content: bytes) -> Iterator[Record]:
        position = 0
        while position < len(content):
            opcode, length = struct.unpack_from('<BQ', content, position)
            position += 9 + length
            if opcode == 0 or position > len(content):
                raise DamageError('no whole record where one should be')
            record = content[position - length : position] if opcode in (3, 4, 5) else b''
            yield from _mcap_record(opcode, record, schemas, channels)

    packed = body[start : start + stored]
    yield from _chunk_records(*unpack(compression, packed, declared, crc), cut, parse)


def _mcap_record(
    opcode: int, body: bytes, schemas: dict[int, str], channels: Channels
) -> Iterator[Record]:
    """The record of a message (5); schemas (3) and channels (4) are added."""
    if opcode == 3:
        schemas[struct.unpack_from('<H', body)[0]] = _string(body, 2)
    elif opcode == 4:
        key, schema = struct.unpack_from('<HH', body)
        channels.setdefault(key, (_string(body, 4), schemas.get(schema, '')))
    elif opcode == 5:
        channel, _, time, _ = struct.unpack_from('<HIQQ', body)
        yield Record(*channels[channel], time, body[22:])


def _string(body: bytes, start: int) -> str:
    (size,) = struct.unpack_from('<I', body, start)
    return body[start + 4 : start + 4 + size].decode()


def _rosbag1_parts(path: Path, channels: Channels) -> Iterator[Part]:
    chunk: Part | None = None
    with path.open('rb') as file:
        file.readline()  # '#ROSBAG V2.0'
        while head := file.read(4):
            fields = _fields(_whole(file.read(size := _size(head)), size))
            size, place = _size(file.read(4)), file.tell()
            cut = place + size > path.stat().st_size
            if fields[b'op'] == b'\x05':
                chunk = Part(0, partial(_rosbag1_chunk, path, place, size, cut, fields, channels))
                yield chunk
            elif fields[b'op'] == b'\x04' and chunk:  # what the chunk before holds
                chunk.channels.add(_size(fields[b'conn']))
            elif fields[b'op'] == b'\x07' and not cut:
                list(_rosbag1_record(fields, file.read(size), channels))
            if cut:
                raise DamageError('file ends within a record')
            file.seek(place + size)
    if not channels:
        raise DamageError('file ends without an index')


def _rosbag1_chunk(
    path: Path, place: int, size: int, cut: bool, fields: dict[bytes, bytes], channels: Channels
) -> Iterator[Record]:
    with path.open('rb') as file:
        file.seek(place)
        data = file.read(size)

    def parse(content: bytes) -> Iterator[Record]:
        stream = io.BytesIO(content)
        while head := stream.read(4):
            header, body = _whole(stream.read(n := _size(head)), n), stream.read(4)
            body = _whole(stream.read(n := _size(body)), n)
            yield from _rosbag1_record(_fields(header), body, channels)

    compression = fields[b'compression'].decode()
    yield from _chunk_records(*unpack(compression, data, _size(fields[b'size'])), cut, parse)


def _rosbag1_record(
    fields: dict[bytes, bytes], body: bytes, channels: Channels
) -> Iterator[Record]:
    """The record of a message (op 2); a connection (op 7) is added."""
    if fields[b'op'] == b'\x07':
        package, _, name = _fields(body)[b'type'].decode().partition('/')
        topic = fields[b'topic'].decode(), f'{package}/msg/{name}'
        channels.setdefault(_size(fields[b'conn']), topic)
    elif fields[b'op'] == b'\x02':
        seconds, nanoseconds = struct.unpack('<II', fields[b'time'])
        time = seconds * 10**9 + nanoseconds
        yield Record(*channels[_size(fields[b'conn'])], time, body)


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Fields of a header of a ROS 1 bag."""
    fields, position = {}, 0
    while position < len(header):
        size = _size(header[position : position + 4])
        name, _, value = header[position + 4 : position + 4 + size].partition(b'=')
        fields[name] = value
        position += 4 + size
    return fields


def _size(data: bytes) -> int:
    return int(struct.unpack('<I', _whole(data, 4))[0])


def _whole(data: bytes, size: int) -> bytes:
    if len(data) < size:
        raise DamageError('file ends within a record')
    return data


def _sqlite_parts(path: Path, channels: Channels) -> Iterator[Part]:
    yield Part(0, partial(_sqlite_records, path, 'timestamp' if channels else 'id'))


def _sqlite_records(path: Path, order: str) -> Iterator[Record]:
    uri = f'{path.absolute().as_uri()}?immutable=1'
    with closing(sqlite3.connect(uri, uri=True)) as database:
        # Without this, sqlite refuses any file shorter than its header says.
        database.execute('PRAGMA writable_schema = ON')
        topics = {row[0]: row[1:] for row in database.execute('SELECT id, name, type FROM topics')}
        # In the order of ids the pages are read from the front, and no index is needed.
        rows = database.execute(f'SELECT topic_id, timestamp, data FROM messages ORDER BY {order}')
        for topic, time, data in rows:
            name, kind = topics[topic]
            yield Record(name, kind, time, data)


_PARTS: dict[str, Callable[[Path, Channels], Iterator[Part]]] = {
    '.mcap': _mcap_parts,
    '.bag': _rosbag1_parts,
    '.db3': _sqlite_parts,
}
