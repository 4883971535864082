"""Recordings, whole or damaged: rosbag2 (mcap, sqlite3) and ROS 1 bags, read by `rosbags`.

What that lacks is here: an mcap file is read up to where it is cut off, as the recorder leaves it
when it is killed, and without a damaged chunk.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import MAXSIZE, McapReader, msgsrc
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rangeseg_ros.io.files import FileError, check_regular, natural_order
from rangeseg_ros.messages.make import TRANSFORMS

Own = TypeVar('Own', bound='Closing')

EARLY_TRANSFORMS = 'tf/msg/tfMessage'
"""Of ROS 1, until its nodes used tf2."""
# Of mcap: the records that end the data, and the bytes of a record before its content.
_FOOTER, _DATA_END, _HEAD = 2, 15, 9


class BagError(FileError):
    """A recording that cannot be read or written, or that lacks depth images or their camera."""


@cache
def message_types(distribution: Stores) -> Typestore:
    """Message types of a ROS distribution; compiled once, at their first use."""
    store = get_typestore(distribution)
    if distribution is Stores.ROS1_NOETIC:
        # `rosbags` has them for ROS 2 only.
        for kind in (TRANSFORMS, EARLY_TRANSFORMS):
            store.register(get_types_from_msg('geometry_msgs/TransformStamped[] transforms', kind))
    return store


def make_rosbags(kind: str, **fields: Any) -> Any:
    """Make a message of `rosbags`' Jazzy types, see `messages.Make`."""
    return message_types(Stores.ROS2_JAZZY).types[kind](**fields)


def is_rosbag1(path: Path) -> bool:
    """Whether it is a bag of ROS 1, and no folder of a rosbag2 that is called *.bag."""
    return path.suffix == '.bag' and not path.is_dir()


class Closing:
    """What is closed at the end of a with statement."""

    def close(self) -> None:
        """Close the files."""

    def __enter__(self: Own) -> Own:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


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


class _McapReader(McapReader):
    """Reads what is whole: each chunk by itself, and a file without its end up to there."""

    damage = cut = ''

    def open(self) -> None:
        try:
            super().open()
        except PermissionError:
            raise
        # Readers meet damaged bytes with exceptions of every kind.
        except Exception as error:
            if not self.data_start:  # no mcap at all
                raise
            self.cut = self.damage = f'without its end: {error}'
            self.bio = self.path.open('rb')
            self.data_end = _end_of_whole_records(self.bio, self.data_start)
            self.meta_scan()
            counts = self.statistics.channel_message_counts if self.statistics else {}
            self.connections = [
                connection._replace(msgcount=counts.get(connection.id, 0))
                for connection in self.connections
            ]

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Any:
        if not self.chunks:
            return self.messages_scan(connections, start, stop)
        wanted = {connection.id: connection for connection in connections}
        chunks = [c for c in self.chunks if any(c.channel_count.get(key, 0) for key in wanted)]
        merged = heapq.merge(*(self._of_chunk(c, wanted) for c in chunks), key=itemgetter(0))
        return ((message[2], message[0], message[3]) for message in merged if message[2])

    def _of_chunk(self, chunk: Any, wanted: dict[int, Connection]) -> Iterator[Any]:
        assert self.bio
        try:
            yield from msgsrc(chunk, wanted, 0, MAXSIZE, self.bio)
        except Exception as error:
            self.damage = f'damaged chunk: {error}'


def _end_of_whole_records(file: BinaryIO, start: int) -> int:
    """Where the last whole record of the data of an mcap file ends."""
    size = file.seek(0, 2)
    while True:
        file.seek(start)
        head = file.read(_HEAD)
        end = start + _HEAD + int.from_bytes(head[1:], 'little')
        if len(head) < _HEAD or head[0] in (_FOOTER, _DATA_END) or end > size:
            return start
        start = end


class _DirectoryReader(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {**DirectoryReader.STORAGE_PLUGINS, 'mcap': _McapReader}


class _Reader(rosbag2.Reader):
    STORAGE_PLUGINS: Mapping[str, Any] = {
        **rosbag2.Reader.STORAGE_PLUGINS,
        'dir': _DirectoryReader,
        '.mcap': _McapReader,
    }


class Recording(Closing):
    """A rosbag2 (directory, .mcap or .db3 file) or a ROS 1 .bag; BagError where it is neither.

    `types` are the message types of the topics, in the ROS 2 form; `counts` the numbers of their
    messages, of a file without its end those that can be read; `connections` all that is recorded
    of them. `cut` says why a file has no end; empty when all have.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.types: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self._readers: list[Any] = []
        for part in path.iterdir() if path.is_dir() else [path]:
            check_regular(part)
        try:
            path.stat()
            for reader in _readers(path):
                reader.open()
                self._readers.append(reader)
        except (FileNotFoundError, PermissionError) as error:
            self.close()
            raise BagError(f'{path}: {error.strerror}') from None
        # Readers meet damaged bytes with exceptions of every kind.
        except Exception as error:
            self.close()
            raise BagError(f'{path}: not a readable bag: {error}') from None
        self.cut = next((storage.cut for storage in self._storages() if storage.cut), '')
        # Where a file is cut off, the metadata of its folder count what is gone.
        readers = self._storages() if self.cut else self._readers
        self.connections = [c for reader in readers for c in reader.connections]
        for connection in self.connections:
            self.types[connection.topic] = connection.msgtype
            self.counts[connection.topic] += connection.msgcount

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time and content of the messages on `topics`, in the order of their times.

        A bag's own definitions are not used, so that odd ones elsewhere in it do no harm. `Lost`
        is the content of what cannot be read; at the end of a recording without its end, BagError.
        """
        ros1 = is_rosbag1(self.path)
        store = message_types(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        deserialize: Any = store.deserialize_ros1 if ros1 else store.deserialize_cdr
        for record in self.records(topics):
            message: Any = record
            if isinstance(record, Record):
                try:
                    message = deserialize(record.data, record.type)
                except Exception as error:
                    message = Lost(record.topic, record.time, 1, f'damaged message: {error!r}')
            yield record.topic, record.time, message

    def records(self, topics: Collection[str]) -> Iterator[Record | Lost]:
        """Iterate over messages on `topics` as they are stored; order and errors as `messages`."""
        missing = Counter({topic: self.counts[topic] for topic in topics})
        damage, time = '', 0
        for reader in self._readers:
            wanted = [c for c in reader.connections if c.topic in topics]
            try:
                for connection, time, data in reader.messages(wanted) if wanted else ():
                    missing[connection.topic] -= 1
                    yield Record(connection.topic, connection.msgtype, time, bytes(data))
            except Exception as error:
                damage = str(error) or type(error).__name__
        damage = damage or next((s.damage for s in self._storages() if s.damage), '')
        if self.cut:
            raise BagError(damage)
        for topic, count in (+missing).items() if damage else ():
            yield Lost(topic, time, count, damage)

    def close(self) -> None:
        """Close the files."""
        for reader in self._readers:
            reader.close()

    def _storages(self) -> list[_McapReader]:
        storages = (getattr(reader, 'storage', reader) for reader in self._readers)
        parts = [part for one in storages for part in getattr(one, 'storages', [one])]
        return [part for part in parts if isinstance(part, _McapReader)]


def _readers(path: Path) -> list[Any]:
    """One reader, or of a folder without metadata one for each file."""
    if is_rosbag1(path):
        return [rosbag1.Reader(path)]
    if not path.is_dir() or (path / 'metadata.yaml').exists():
        return [_Reader(path)]
    parts = sorted([*path.glob('*.mcap'), *path.glob('*.db3')], key=natural_order)
    if not parts:
        raise ValueError('the folder has no metadata.yaml')
    return [_Reader(part) for part in parts]
