"""Organised point clouds in recordings: rosbag2 (mcap, sqlite3) and ROS 1 bags."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.message_types import CLOUD, COMPRESSED_IMAGE, IMAGE
from rangeseg_ros.io.recordings import BagError, Lost, Recording, RecordingError
from rangeseg_ros.messages.frames import DepthFrame


class CloudBag:
    """Iterates over the point clouds of one recording, in the order of the recording.

    Parameters
    ----------
    path : Path
        As of `DepthBag`.
    topic : str
        Of the clouds.
    """

    def __init__(self, path: Path, topic: str) -> None:
        self.path, self.topic = path, topic
        self._recording = Recording(path)

    def __enter__(self) -> CloudBag:
        return self

    def __exit__(self, *exception: object) -> None:
        self._recording.close()

    def __len__(self) -> int:
        return self._recording.counts[self.topic]

    def __iter__(self) -> Iterator[DepthFrame]:
        for _, time, message in self._recording.messages((self.topic,)):
            if not isinstance(message, Lost):
                yield DepthFrame(message, None, time)


def open_frames(path: Path, topic: str | None, camera_topic: str | None) -> DepthBag | CloudBag:
    """Frames of a recording: those on `topic`, else depth images, else the only point clouds.

    Raises
    ------
    BagError
        See `DepthBag`; also several topics of clouds, and no other.
    """
    try:
        recording = Recording(path)
    except (OSError, RecordingError):
        return DepthBag(path, topic, camera_topic)  # which says what is wrong
    kinds, counts = dict(recording.types), recording.counts
    clouds = sorted(name for name, kind in kinds.items() if kind == CLOUD and counts[name])
    recording.close()
    if topic in clouds:
        return CloudBag(path, topic)
    if topic or not clouds or {IMAGE, COMPRESSED_IMAGE} & set(kinds.values()):
        return DepthBag(path, topic, camera_topic)
    if len(clouds) > 1:
        raise BagError(f'{path}: several topics of point clouds: {", ".join(clouds)}')
    return CloudBag(path, clouds[0])
