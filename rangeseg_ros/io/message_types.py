"""Messages of recordings: their types and their contents."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rangeseg_ros.io.chunks import Lost, Record

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'


@cache
def message_types(distribution: Stores) -> Typestore:
    """Message types of a ROS distribution; compiled once, at their first use."""
    return get_typestore(distribution)


def make_rosbags(kind: str, **fields: Any) -> Any:
    """Make a message of `rosbags`' Jazzy types, see `messages.Make`."""
    return message_types(Stores.ROS2_JAZZY).types[kind](**fields)


def deserialized(
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
