"""Chunks of recordings, mcap and ROS 1: each is read by itself, within the size it declares."""

from __future__ import annotations

import bz2
import heapq
import io
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter, itemgetter
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import lz4.frame
import zstandard

_PIECE = 2**20
# What is compressed may become so many bytes, 16 times the largest chunks that recorders make by
# their presets, and more only where more is stored.
_LARGEST, _EXPANSION = 2**26, 16


class ChunkError(ValueError):
    """A chunk that is damaged."""


class Record(NamedTuple):
    """A message as it is stored; `time` is that of its recording, nanoseconds."""

    topic: str
    type: str
    time: int
    data: bytes


class Lost(NamedTuple):
    """So many messages of a topic, in place of which there is damage."""

    topic: str
    time: int
    messages: int
    reason: str


_STREAMS: dict[str, Callable[[BinaryIO], Any]] = {
    '': lambda file: file,
    'none': lambda file: file,
    'zstd': lambda file: zstandard.ZstdDecompressor().stream_reader(file),
    'lz4': lz4.frame.open,
    'bz2': bz2.open,
}


class ChunkReader:
    """Reads the content of a chunk from front to back.

    Parameters
    ----------
    compression : str
        '', 'none', 'zstd', 'lz4' or 'bz2'.
    data : bytes
        As stored.
    size : int
        What the chunk declares to hold, bytes.

    Attributes
    ----------
    left : int
        Bytes that have not been read yet.
    crc : int
        Checksum of those that have.

    Raises
    ------
    ChunkError
        Of another compression, or far larger than what is stored; here and while reading, whatever
        does not fit the declared size.
    """

    def __init__(self, compression: str, data: bytes, size: int) -> None:
        if compression not in _STREAMS:
            raise ChunkError(f'unknown compression {compression!r}')
        if compression not in ('', 'none'):
            check_expansion(len(data), size)
        self._stream = _STREAMS[compression](io.BytesIO(data))
        self.left = size
        self.crc = 0

    def read(self, size: int) -> bytes:
        """Read exactly so many bytes."""
        if size > self.left:
            raise ChunkError('a record exceeds its chunk')
        data: bytes = self._stream.read(size)
        if len(data) < size:
            raise ChunkError('chunk ends early')
        self.left -= size
        self.crc = crc32(data, self.crc)
        return data

    def skip(self, size: int) -> None:
        """Pass over so many bytes."""
        while size > 0:
            size -= len(self.read(min(size, _PIECE)))

    def finish(self) -> None:
        """Raise ChunkError unless this is the end."""
        if self.left or self._stream.read(1):
            raise ChunkError('chunk is not as large as it declares')


def check_expansion(stored: int, size: int) -> None:
    """Raise ChunkError where compressed bytes declare to become far more."""
    if size > max(_LARGEST, _EXPANSION * stored):
        raise ChunkError(f'{stored} compressed bytes declare to be {size}')


@dataclass(frozen=True)
class Chunk:
    """A chunk of an indexed recording.

    Attributes
    ----------
    start : int
        Time of its first message, nanoseconds.
    counts : mapping
        Topic -> how many messages of it.
    read : callable
        Gives the records.
    """

    start: int
    counts: Mapping[str, int]
    read: Callable[[], list[Record]]


def merged(chunks: list[Chunk]) -> Iterator[Record | Lost]:
    """Records of chunks in the order of their times; `Lost` for those of damaged chunks."""
    streams = [_timed(chunk) for chunk in chunks]
    for _, record in heapq.merge(*streams, key=itemgetter(0)):
        if record:
            yield record


def _timed(chunk: Chunk) -> Iterator[tuple[int, Record | Lost | None]]:
    # First its time alone: a chunk is read when that has come.
    yield chunk.start, None
    try:
        for record in sorted(chunk.read(), key=attrgetter('time')):
            yield record.time, record
    # Decompressors meet damaged bytes with exceptions of every kind.
    except Exception as error:
        reason = f'damaged chunk: {error}'
        for topic, count in chunk.counts.items():
            yield chunk.start, Lost(topic, chunk.start, count, reason)


class McapChannels:
    """Topics and types of an mcap file, by the records that define them."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, tuple[str, str]] = {}

    def define(self, opcode: int, body: bytes) -> None:
        """Take in a record of a schema (3) or a channel (4)."""
        if opcode == 3:
            (key,) = struct.unpack_from('<H', body)
            self.schemas[key] = _string(body, 2)
        elif opcode == 4:
            key, schema = struct.unpack_from('<HH', body)
            self.channels[key] = _string(body, 4), self.schemas.get(schema, '')

    def message(self, body: bytes) -> Record:
        """Record of a message (5)."""
        channel, _, time, _ = struct.unpack_from('<HIQQ', body)
        return Record(*self.channels[channel], time, body[22:])


def mcap_chunk_sizes(head: bytes) -> tuple[int, int]:
    """Bytes that a chunk of mcap stores and declares, from the front of its record."""
    (size,) = struct.unpack_from('<Q', head, 16)
    (stored,) = struct.unpack_from('<Q', head, 32 + len(_string(head, 28)))
    return stored, size


def mcap_chunk(body: bytes, channels: McapChannels) -> Iterator[Record]:
    """Records of a chunk of mcap; of a damaged one those before the damage, then ChunkError.

    Parameters
    ----------
    body : bytes
        Content of the chunk's record, perhaps cut off.
    channels : McapChannels
        Those the chunk defines are added.
    """
    _, _, size, crc = struct.unpack_from('<QQQI', body)
    compression = _string(body, 28)
    start = 28 + 4 + len(compression) + 8
    (stored,) = struct.unpack_from('<Q', body, start - 8)
    reader = ChunkReader(compression, body[start : start + stored], size)
    while reader.left:
        opcode, length = struct.unpack('<BQ', reader.read(9))
        if opcode == 0:
            raise ChunkError('no record where one should begin')
        if opcode in (3, 4):
            channels.define(opcode, reader.read(length))
        elif opcode == 5:
            yield channels.message(reader.read(length))
        else:
            reader.skip(length)
    reader.finish()
    if crc and crc != reader.crc:
        raise ChunkError('its checksum does not match')


def _string(body: bytes, start: int) -> str:
    (size,) = struct.unpack_from('<I', body, start)
    return body[start + 4 : start + 4 + size].decode()


Connections = dict[bytes, tuple[str, str]]
"""Topic and type of each connection of a ROS 1 bag, by its four bytes."""


def rosbag1_chunk(
    fields: Mapping[bytes, bytes], data: bytes, connections: Connections
) -> Iterator[Record]:
    """Records of a chunk of a ROS 1 bag; of a damaged one those before the damage.

    Parameters
    ----------
    fields : mapping
        Header of the chunk's record.
    data : bytes
        Content of the chunk's record, perhaps cut off.
    connections : Connections
        Those the chunk defines are added.
    """
    (size,) = struct.unpack('<I', fields[b'size'])
    reader = ChunkReader(fields[b'compression'].decode(), data, size)
    while reader.left:
        header, body = (reader.read(struct.unpack('<I', reader.read(4))[0]) for _ in range(2))
        yield from rosbag1_message(rosbag1_fields(header), body, connections)
    reader.finish()


def rosbag1_message(
    fields: Mapping[bytes, bytes], body: bytes, connections: Connections
) -> Iterator[Record]:
    """Record of a message (op 2), if it is one; a connection (op 7) is added."""
    if fields[b'op'] == b'\x07':
        package, _, name = rosbag1_fields(body)[b'type'].decode().partition('/')
        connections[fields[b'conn']] = fields[b'topic'].decode(), f'{package}/msg/{name}'
    elif fields[b'op'] == b'\x02':
        seconds, nanoseconds = struct.unpack('<II', fields[b'time'])
        yield Record(*connections[fields[b'conn']], seconds * 10**9 + nanoseconds, body)


def rosbag1_fields(header: bytes) -> dict[bytes, bytes]:
    """Fields of a header of the ROS 1 bag format 2.0 (wiki.ros.org/Bags/Format/2.0)."""
    fields, position = {}, 0
    while position < len(header):
        (size,) = struct.unpack_from('<I', header, position)
        name, _, value = header[position + 4 : position + 4 + size].partition(b'=')
        fields[name] = value
        position += 4 + size
    return fields


def rosbag1_part(file: BinaryIO) -> bytes:
    """Next header or data of a ROS 1 bag, whose size comes first."""
    size = rosbag1_size(file.read(4))
    return whole(file.read(size), size)


def rosbag1_size(data: bytes) -> int:
    """Size of a part of a ROS 1 bag."""
    return int(struct.unpack('<I', whole(data, 4))[0])


def whole(data: bytes, size: int) -> bytes:
    """Return `data`; EOFError when it is shorter than that."""
    if len(data) < size:
        raise EOFError('file ends within a record')
    return data
