"""Recordings of two walls, and what `rangeseg replay` makes of them."""

import csv

import numpy as np
from recordings import ROS2, UNKNOWN, Recording, stamp_of
from rosbags import rosbag2

from rangeseg_ros.batch.replay import Replay
from rangeseg_ros.core.config import Config

DELAY = 5_000_000
"""Nanoseconds from the stamp of a message to its recording."""


def walls(count):
    """A near wall on the left, a far one on the right: (count, 48, 64) uint16 millimetres."""
    depth = np.full((count, 48, 64), 2500, np.uint16)
    depth[:, :, :32] = 1500
    return depth + np.arange(count, dtype=np.uint16)[:, None, None]


def record_walls(path, count=4):
    """Record walls with their camera and a topic of a type that nobody knows."""
    recording = Recording()
    for index, image in enumerate(walls(count)):
        recording.add_camera(stamp_of(index))
        recording.add_image(stamp_of(index), image)
        message = ROS2.types[UNKNOWN](index)
        recording.messages.append((stamp_of(index), '/secret', UNKNOWN, message))
    recording.messages = [(time + DELAY, *rest) for time, *rest in recording.messages]
    recording.write(path)
    return path


def read(path):
    """Messages of a bag in their order: time, topic, content, bytes."""
    with rosbag2.Reader(path) as reader:
        return [
            (time, c.topic, ROS2.deserialize_cdr(data, c.msgtype), bytes(data))
            for c, time, data in reader.messages()
        ]


def rows_of(path):
    """Rows of a table, by the names of its columns."""
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


def results(folder):
    """Contents of the files that must not depend on who made them, or when."""
    paths = [path for kind in ('png', 'csv', 'mcap') for path in folder.rglob(f'*.{kind}')]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def replay(recording, folder, **options):
    return Replay(recording, folder, Config(), **options).run()
