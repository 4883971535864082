"""Damaged recordings: what can be read from their front.

The index at the end of a file is missing after a crash of the recorder, on a full disk or after a
broken download; of such a file the records are read one after the other up to the damage.
"""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from rangeseg_ros.io.chunks import (
    Connections,
    McapChannels,
    Record,
    mcap_chunk,
    rosbag1_chunk,
    rosbag1_fields,
    rosbag1_message,
    rosbag1_size,
    whole,
)
from rangeseg_ros.io.files import natural_order
from rangeseg_ros.io.message_types import deserialized

# At both ends of mcap files.
_MCAP = b'\x89MCAP0\r\n'


class DamageError(ValueError):
    """What ends the reading of a recording."""


class DamagedRecording:
    """What can be read from the front of a damaged recording.

    Attributes
    ----------
    types, counts : dict
        As of `recordings.Recording`, up to the damage.
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
        return deserialized(self.path, _scanned(self.path), topics)

    def close(self) -> None:
        """Do nothing; no file stays open."""


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
            raise DamageError('not an mcap file')
        while head := file.read(9):
            opcode, size = struct.unpack('<BQ', whole(head, 9))
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
        raise DamageError(damage)


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
            fields = rosbag1_fields(whole(file.read(size := rosbag1_size(head)), size))
            data = file.read(size := rosbag1_size(file.read(4)))
            if fields[b'op'] == b'\x05':
                records = rosbag1_chunk(fields, data, connections)
                try:
                    yield from records if len(data) < size else list(records)
                except Exception as error:
                    damage = damage or f'damaged chunk: {error}'
            else:
                yield from rosbag1_message(fields, whole(data, size), connections)
            whole(data, size)
    raise EOFError(damage or 'file ends without an index')
