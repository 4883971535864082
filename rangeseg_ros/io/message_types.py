"""Types of the messages of recordings."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rangeseg_ros.messages.make import TRANSFORMS

EARLY_TRANSFORMS = 'tf/msg/tfMessage'
"""Of ROS 1, until its nodes used tf2."""


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
