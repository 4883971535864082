"""Depth images and organised clouds in recordings: rosbag2 (mcap, sqlite3) and ROS 1 bags."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.io.recordings import BagError, Closing, Lost, Recording
from rangeseg_ros.messages.cameras import camera_from_message, raw_by_name
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.messages.images import PIXEL_TYPES
from rangeseg_ros.messages.make import CAMERA_INFO, CLOUD, COMPRESSED_IMAGE, IMAGE

T = TypeVar('T')

IMAGES = (IMAGE, COMPRESSED_IMAGE)


class DamagedBagError(BagError):
    """A recording that cannot be read further than here."""


class DepthBag(Closing):
    """Iterates over the depth frames of one recording, in the order of the recording.

    `path` is a directory or .mcap or .db3 file of a rosbag2, or a .bag file of ROS 1. By default
    the depth image is found by type and name, or encoding; its camera_info is the sibling topic,
    or the only one there is. `raw` says that the images are raw whatever the name of their topic
    says. Where no topic has images, the frames are the only point clouds, which need no camera.
    `camera` is that of images without a camera_info.

    `lost` counts why frames were left out while iterating; whoever iterates notes in `damage`
    what ended the iteration.

    BagError: not a recording, or one without depth images or camera_info (the message lists its
    topics), or without any image of a known encoding that its camera_info fits. DamagedBagError:
    while iterating, after the last frame before the damage.
    """

    def __init__(
        self,
        path: Path,
        depth_topic: str | None = None,
        camera_topic: str | None = None,
        raw: bool = False,
        camera: Camera | None = None,
    ) -> None:
        self.path = path
        self.lost: Counter[str] = Counter()
        self.damage = ''
        self.depth_topic, self.camera_topic = depth_topic or '', ''
        self._raw, self._first_camera = raw, camera
        self._recording = Recording(path)
        try:
            types, counts = self._recording.types, self._recording.counts
            clouds = sorted(name for name in types if types[name] == CLOUD and counts[name])
            if clouds and not depth_topic and set(IMAGES).isdisjoint(types.values()):
                if len(clouds) > 1:
                    raise BagError(f'{path}: several topics of point clouds: {", ".join(clouds)}')
                self.depth_topic = clouds[0]
            self.has_images = self.depth_topic not in clouds
            if not self.has_images:
                return
            self.depth_topic = depth_topic or self._find_depth_topic()
            self._require(self.depth_topic, 'depth image', IMAGES)
            if camera is None:
                self.camera_topic = camera_topic or self._find_camera_topic()
                self._require(self.camera_topic, 'camera_info', (CAMERA_INFO,))
                self._first_camera = self._first(self.camera_topic, self._camera)
            # There is a frame that can be read.
            self._first(self.depth_topic, DepthFrame.range_image, self)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the files."""
        self._recording.close()

    def __len__(self) -> int:
        """Count the depth images, of a damaged recording those before the damage."""
        return self._recording.counts[self.depth_topic]

    def __iter__(self) -> Iterator[DepthFrame]:
        self.lost.clear()
        camera, count, reason = self._first_camera, 0, ''
        try:
            topics = (self.depth_topic, self.camera_topic)
            for topic, time, message in self._recording.messages(topics):
                if topic == self.camera_topic:
                    if isinstance(message, Lost):
                        continue  # the last one may still be right
                    try:
                        camera, reason = self._camera(message), ''
                    except CameraError as error:
                        reason = f'{topic}: {error}'
                elif isinstance(message, Lost):
                    self.lose(message.reason, message.messages)
                elif reason:
                    self.lose(reason)
                else:
                    yield DepthFrame(message, camera, time)
                    count += 1
        # Readers meet damaged bytes with exceptions of every kind.
        except Exception as error:
            reason = str(error) or type(error).__name__
            raise DamagedBagError(
                f'{self.path}: damaged after {count} frames: {reason}'
            ) from error

    def lose(self, reason: str, count: int = 1) -> None:
        """Count frames that cannot be read, or not be segmented."""
        self.lost[reason] += count

    def loss(self) -> str:
        """What was lost while iterating, in words; empty when nothing was."""
        if not self.lost:
            return ''
        total, kinds = self.lost.total(), len(self.lost)
        more = f', and {kinds - 1} other reasons' if kinds > 1 else ''
        reason = self.lost.most_common(1)[0][0]
        return f'{self.path}: {total} of {len(self)} frames left out: {reason}{more}'

    def _camera(self, message: Any) -> Camera:
        return camera_from_message(message, True if self._raw else raw_by_name(self.depth_topic))

    def _first(self, topic: str, made: Callable[[Any], T], items: Iterable[Any] = ()) -> T:
        """What is made of the first item, or message on a topic, of which it can be."""
        reason = f'no message on {topic}'
        self.lost.clear()
        try:
            for item in items or (m for *_, m in self._recording.messages((topic,))):
                if isinstance(item, Lost):
                    self.lose(item.reason)
                    continue
                try:
                    return made(item)
                except ValueError as error:
                    reason = f'{topic}: {error}'
        except Exception as error:
            reason = f'no readable message on {topic}: {error}'
        if self.lost:
            reason = f'no readable message on {topic}: {next(iter(self.lost))}'
        raise BagError(f'{self.path}: {reason}')

    def _find_depth_topic(self) -> str:
        types = self._recording.types
        images = [name for name, kind in types.items() if kind in IMAGES]
        found = [name for name in images if 'depth' in name.lower() and self._may_be_depth(name)]
        found = found or [name for name in images if self._may_be_depth(name)]
        if not found:
            kinds = ', '.join(f'{name}: {self._encoding(name) or "no message"}' for name in images)
            none = f'no depth image ({kinds})' if images else 'no depth image'
            raise BagError(f'{self.path}: {none}; {self._topics_there_are()}')
        return min(
            found,
            key=lambda name: (
                _sibling_camera_info(name) not in types,
                types[name] == COMPRESSED_IMAGE,
                len(name),
                name,
            ),
        )

    def _may_be_depth(self, topic: str) -> bool:
        if self._recording.counts[topic] == 0:
            return False
        encoding = self._encoding(topic)
        if not encoding:
            return 'depth' in topic.lower()
        return 'compressedDepth' in encoding or encoding in PIXEL_TYPES

    def _encoding(self, topic: str) -> str:
        """Encoding of the images on a topic, or format of compressed ones; empty when unknown."""
        try:
            return self._first(topic, lambda m: m.format if hasattr(m, 'format') else m.encoding)
        except BagError:
            return ''

    def _find_camera_topic(self) -> str:
        there = [name for name, kind in self._recording.types.items() if kind == CAMERA_INFO]
        sibling = _sibling_camera_info(self.depth_topic)
        if sibling not in there and len(there) != 1:
            raise BagError(
                f'{self.path}: no camera_info for {self.depth_topic} (replay takes --camera); '
                + self._topics_there_are()
            )
        return sibling if sibling in there else there[0]

    def _require(self, topic: str, what: str, kinds: tuple[str, ...]) -> None:
        if self._recording.types.get(topic) not in kinds:
            raise BagError(f'{self.path}: no {what} on {topic}; {self._topics_there_are()}')

    def _topics_there_are(self) -> str:
        topics = sorted(self._recording.types.items())
        listed = ', '.join(f'{name} [{kind}]' for name, kind in topics) or 'none'
        damage = self._recording.cut
        return f'topics: {listed}' + (f' (damaged: {damage})' if damage else '')


def _sibling_camera_info(image_topic: str) -> str:
    """Topic of the intrinsics, by the convention of image_transport."""
    return re.sub(r'/compressed(Depth)?$', '', image_topic).rpartition('/')[0] + '/camera_info'
