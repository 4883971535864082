"""Transforms in recordings, for their images in turn."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from rangeseg_ros.core.mapping.transforms import Transform, TransformBuffer
from rangeseg_ros.io.recordings import EARLY_TRANSFORMS, BagError, Closing, Lost, Recording
from rangeseg_ros.messages.make import TRANSFORMS
from rangeseg_ros.messages.motion import insert_transforms

MOVING, STATIC = '/tf', '/tf_static'
TYPES = (TRANSFORMS, EARLY_TRANSFORMS)
# Messages at the beginning that tell which frames there are.
_LOOKED_AT = 10_000


class RecordedTransforms(Closing):
    """Transforms that the node would know after it has waited `tf_timeout` for each image.

    All static transforms count from the beginning. Of the others, what was recorded up to
    `timeout` seconds (the parameter `tf_timeout`) after an image is known to it.
    """

    def __init__(self, path: Path, timeout: float) -> None:
        self._recording = Recording(path)
        self._timeout = round(timeout * 1e9)
        self._buffer = TransformBuffer()
        self._moving = self._read()
        self._next = next(self._moving, None)

    def close(self) -> None:
        """Close the files."""
        self._recording.close()

    def lookup(self, target: str, source: str, stamp: int, time: int) -> Transform:
        """As `TransformBuffer.lookup`, for an image recorded at `time`, nanoseconds."""
        while self._next and self._next[0] <= time + self._timeout:
            insert_transforms(self._buffer, self._next[1], static=False)
            self._next = next(self._moving, None)
        return self._buffer.lookup(target, source, stamp)

    def _read(self) -> Iterator[tuple[int, Any]]:
        """Take in what is static; times and messages of what moves."""
        try:
            for _, message in _messages(self._recording, STATIC):
                insert_transforms(self._buffer, message, static=True)
            yield from _messages(self._recording, MOVING)
        # The damage is told by whoever reads the images. Up to it all is used.
        except Exception:
            return


def _messages(recording: Recording, topic: str) -> Iterator[tuple[int, Any]]:
    """Times and contents of the messages on a topic of transforms that can be read."""
    if recording.types.get(topic) in TYPES:
        for _, time, message in recording.messages([topic]):
            if not isinstance(message, Lost):
                yield time, message


def fixed_frame_of(path: Path) -> str:
    """Frame in which the tf of a recording moves: above all others, and not only statically.

    Of several `map` counts before `odom` and `world`; empty where nothing moves.
    """
    parents: dict[str, str] = {}
    moving: set[str] = set()
    # If the recording is cut off, whoever reads the images reports it.
    with Recording(path) as recording, suppress(BagError):
        for topic in (STATIC, MOVING):
            for _, message in islice(_messages(recording, topic), _LOOKED_AT):
                for one in message.transforms:
                    child = one.child_frame_id.removeprefix('/')
                    parents[child] = one.header.frame_id.removeprefix('/')
                    moving |= {child} if topic == MOVING else set()
    found = set()
    for frame in moving:
        above = [frame]
        while above[-1] in parents and parents[above[-1]] not in above:
            above.append(parents[above[-1]])
        found.add(above[-1])
    return next((name for name in ['map', 'odom', 'world', *sorted(found)] if name in found), '')
