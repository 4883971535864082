"""The bag that a replay writes: what the node would have published, and copied topics."""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import Connection, MessageDefinitionFormat

from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.io.bag_writer import BagWriter
from rangeseg_ros.io.recordings import BagError, Lost, Recording, is_rosbag1, make_rosbags
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.make import ODOMETRY, header_of
from rangeseg_ros.messages.motion import odometry_message
from rangeseg_ros.messages.outputs import OUTPUTS, messages_of

NAMESPACE = '/segment_planes'
"""Name of the node that publishes the topics."""

_KEY = 'rangeseg_replay'

Timed = tuple[int, Connection, bytes]
"""When, where and what is written."""


class ResultBag(BagWriter):
    """Writes a rosbag2 (mcap) of results; see `messages.Make` for why it equals the node's.

    In a directory to make; `topics` are names of `OUTPUTS`, and `odometry` says whether the motion
    of the camera is among them. `lost` counts messages that could not be copied, by topic and
    reason.
    """

    def __init__(self, path: Path, topics: Iterable[str], odometry: bool = False) -> None:
        super().__init__(path, compressed=True)  # labels shrink to a hundredth
        self._kinds = {name: OUTPUTS[name].kind for name in topics}
        self._motion = {'odometry': ODOMETRY} if odometry else {}
        self.lost: Counter[str] = Counter()

    def __enter__(self) -> ResultBag:
        super().__enter__()
        self._topics = {
            name: self.topic(f'{NAMESPACE}/{name}', kind)
            for name, kind in (self._kinds | self._motion).items()
        }
        return self

    def record(self, facts: Mapping[str, Any]) -> None:
        """Put `facts` into the metadata, for `read_record`."""
        self.set_custom_data(_KEY, json.dumps(facts, sort_keys=True))

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
        header = header_of(make_rosbags, frame.stamp, frame.frame_id)
        made = list(messages_of(make_rosbags, header, image, result, target, self._kinds))
        if motion:
            made.append(('odometry', odometry_message(make_rosbags, header, motion)))
        for name, message in made:
            topic = self._topics[name]
            yield frame.time, topic, self.serialised(topic, message)

    def copies(self, source: Recording) -> Iterator[Timed]:
        """All messages of `source`, as they are, but those on the topics of results.

        What is damaged is left out; `lost` counts it.
        """
        own = {connection.topic for connection in self._topics.values()}
        kinds = {(c.topic, c.msgtype): c for c in source.connections if c.topic not in own}
        here = {kind: self._like(connection) for kind, connection in kinds.items()}
        for record in source.records({topic for topic, _ in here}):
            if isinstance(record, Lost):
                self.lost[f'{record.topic}: {record.reason}'] += record.messages
            elif (record.topic, record.type) in here:
                yield record.time, here[record.topic, record.type], record.data

    def write_merged(self, *streams: Iterable[Timed]) -> None:
        """Write messages of several sources, each ordered by time, in the order of all times."""
        for time, connection, data in heapq.merge(*streams, key=lambda timed: timed[0]):
            self.write(connection, time, data)

    def _like(self, connection: Connection) -> Connection:
        """A topic of this bag with the type and the quality of service of that one."""
        definition: dict[str, Any] = {
            'msgdef': connection.msgdef.data,
            'rihs01': connection.digest,
        }
        # Recordings of ROS 2 before Iron do not define their types.
        if connection.msgdef.format == MessageDefinitionFormat.NONE or not connection.digest:
            if connection.msgtype not in self.types.fielddefs:
                raise BagError(
                    f'{connection.topic} cannot be copied: '
                    f'the recording does not define {connection.msgtype}'
                )
            definition = {'typestore': self.types}
        ext: Any = connection.ext
        return self.add_connection(
            connection.topic,
            connection.msgtype,
            serialization_format=ext.serialization_format,
            offered_qos_profiles=ext.offered_qos_profiles,
            **definition,
        )


def open_source(path: Path) -> Recording:
    """Open a recording to copy from; BagError unless it is a whole rosbag2."""
    source = Recording(path)
    if damage := 'ROS 1' if is_rosbag1(path) else source.cut:
        source.close()
        raise BagError(f'{path}: not a whole rosbag2 to copy from: {damage}')
    return source


def read_record(path: Path) -> dict[str, Any]:
    """What `ResultBag.record` put into the bag; empty for any other folder."""
    try:
        metadata = yaml.safe_load((path / 'metadata.yaml').read_text())
        record = json.loads(metadata['rosbag2_bagfile_information']['custom_data'][_KEY])
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        return {}
    return record if isinstance(record, dict) else {}
