"""The bag that a replay writes: what the node would have published, and copied topics."""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.typesys import Stores

from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.io.bag_writer import BagWriter
from rangeseg_ros.io.message_types import is_rosbag1, make_rosbags, message_types
from rangeseg_ros.io.recordings import BagError, Lost, Recording
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.motion import ODOMETRY, odometry_message
from rangeseg_ros.messages.outputs import IN_TARGET, OUTPUTS, in_target

NAMESPACE = '/segment_planes'
"""Name of the node that publishes the topics."""

_KEY = 'rangeseg_replay'

Timed = tuple[int, Connection, bytes]
"""When, where and what is written."""


class ResultBag:
    """Writes a rosbag2 (mcap) of results; see `messages.Make` for why it equals the node's.

    Parameters
    ----------
    path : Path
        Directory to make.
    topics : iterable of str
        Which of `OUTPUTS`, by name.
    odometry : bool
        Whether the motion of the camera is among them.

    Attributes
    ----------
    lost : Counter of str
        Topic and reason of messages that could not be copied -> how many.
    """

    def __init__(self, path: Path, topics: Iterable[str], odometry: bool = False) -> None:
        self._store = message_types(Stores.ROS2_JAZZY)
        # Labels shrink to a hundredth.
        self._writer = BagWriter(path, compressed=True)
        self._names = tuple(topics)
        self._kinds = {name: OUTPUTS[name].kind for name in self._names}
        if odometry:
            self._kinds['odometry'] = ODOMETRY
        self.lost: Counter[str] = Counter()
        self._topics: dict[str, Connection] = {}

    def __enter__(self) -> ResultBag:
        self._writer.open()
        for name, kind in self._kinds.items():
            self._topics[name] = self._writer.add_connection(
                f'{NAMESPACE}/{name}', kind, typestore=self._store
            )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def record(self, facts: Mapping[str, Any]) -> None:
        """Put `facts` into the metadata, for `read_record`."""
        self._writer.set_custom_data(_KEY, json.dumps(facts, sort_keys=True))

    def messages(
        self,
        frame: DepthFrame,
        image: RangeImage,
        result: Segmentation,
        target: tuple[str, Transform] | None = None,
        motion: Motion | None = None,
    ) -> Iterator[Timed]:
        """What is published of `result`, at the time of the frame's recording.

        `target` is the frame of planes and markers, and the motion to it; `motion` that of the
        camera, where it is followed.
        """
        sec, nanosec = divmod(frame.stamp, 10**9)
        stamp = make_rosbags('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
        header = make_rosbags('std_msgs/msg/Header', stamp=stamp, frame_id=frame.frame_id)
        here = header, result
        there = in_target(make_rosbags, header, result, *target) if target else here
        for name in self._names:
            connection = self._topics[name]
            head, shown = there if name in IN_TARGET else here
            message = OUTPUTS[name].message(make_rosbags, head, image, shown)
            if not isinstance(message, bytes):
                message = bytes(self._store.serialize_cdr(message, connection.msgtype))
            yield frame.time, connection, message
        if motion:
            connection = self._topics['odometry']
            message = odometry_message(make_rosbags, header, motion)
            data = self._store.serialize_cdr(message, ODOMETRY)
            yield frame.time, connection, bytes(data)

    def copies(self, source: Recording) -> Iterator[Timed]:
        """All messages of `source`, as they are, but those on the topics of results.

        What is damaged is left out; `lost` counts it.
        """
        own = {connection.topic for connection in self._topics.values()}
        here = {
            (connection.topic, connection.msgtype): self._like(connection)
            for connection in source.connections
            if connection.topic not in own
        }
        for record in source.records({topic for topic, _ in here}):
            if isinstance(record, Lost):
                self.lost[f'{record.topic}: {record.reason}'] += record.messages
            elif (record.topic, record.type) in here:
                yield record.time, here[record.topic, record.type], record.data

    def write(self, *streams: Iterable[Timed]) -> None:
        """Write messages of several sources, each ordered by time, in the order of all times."""
        for time, connection, data in heapq.merge(*streams, key=lambda timed: timed[0]):
            self._writer.write(connection, time, data)

    def _like(self, connection: Connection) -> Connection:
        """A topic of this bag with the type and the quality of service of that one."""
        definition: dict[str, Any] = {
            'msgdef': connection.msgdef.data,
            'rihs01': connection.digest,
        }
        # Recordings of ROS 2 before Iron do not define their types.
        if connection.msgdef.format == MessageDefinitionFormat.NONE or not connection.digest:
            if connection.msgtype not in self._store.fielddefs:
                raise BagError(
                    f'{connection.topic} cannot be copied: '
                    f'the recording does not define {connection.msgtype}'
                )
            definition = {'typestore': self._store}
        ext: Any = connection.ext
        return self._writer.add_connection(
            connection.topic,
            connection.msgtype,
            serialization_format=ext.serialization_format,
            offered_qos_profiles=ext.offered_qos_profiles,
            **definition,
        )


def open_source(path: Path) -> Recording:
    """Open a recording to copy from; BagError unless it is a whole rosbag2."""
    try:
        if is_rosbag1(path):
            raise BagError('ROS 1')
        source = Recording(path)
        if source.cut:
            raise BagError(source.cut)
        return source
    # Readers meet damaged bytes with exceptions of every kind.
    except Exception as error:
        raise BagError(f'{path}: not a whole rosbag2 to copy from: {error}') from None


def read_record(path: Path) -> dict[str, Any]:
    """What `ResultBag.record` put into the bag; empty for any other folder."""
    try:
        metadata = yaml.safe_load((path / 'metadata.yaml').read_text())
        record = json.loads(metadata['rosbag2_bagfile_information']['custom_data'][_KEY])
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        return {}
    return record if isinstance(record, dict) else {}
