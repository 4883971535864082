"""Recordings of two walls, and what `rangeseg replay` makes of them."""

import numpy as np
from recordings import ROS2, Recording
from rosbags import rosbag2

from rangeseg_ros.batch.replay import Replay
from rangeseg_ros.core.config import Config

DELAY = 5_000_000
"""Nanoseconds from the stamp of a message to its recording."""


def walls(count, height=48, width=64):
    """A near wall on the left, a far one on the right: (count, H, W) uint16 millimetres."""
    depth = np.full((count, height, width), 2500, np.uint16)
    depth[:, :, : width // 2] = 1500
    return depth + np.arange(count, dtype=np.uint16)[:, None, None]


def record_walls(path, count=4):
    """Record walls with their camera and a topic of another kind."""
    recording = Recording()
    types = recording.store.types
    for index, image in enumerate(walls(count)):
        stamp = 10**18 + index * 33_333_333
        recording.add_camera(stamp)
        recording.add_image(stamp, image)
        text = types['std_msgs/msg/String'](f'frame {index}')
        recording.messages.append((stamp, '/notes', 'std_msgs/msg/String', text))
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


def results(folder):
    """Contents of the files that must not depend on who made them, or when."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob('*'))
        if path.is_file() and path.suffix in ('.png', '.csv', '.mcap')
    }


def replay(recording, folder, **options):
    return Replay(recording, folder, Config(), **options).run()
