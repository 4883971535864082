"""Transforms in recordings, for their images in turn."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

from rangeseg_ros.core.mapping.transforms import Transform, TransformBuffer
from rangeseg_ros.io.message_types import EARLY_TRANSFORMS, TRANSFORMS
from rangeseg_ros.io.recordings import Lost, Recording
from rangeseg_ros.messages.transforms import insert_transforms

MOVING, STATIC = '/tf', '/tf_static'
TYPES = (TRANSFORMS, EARLY_TRANSFORMS)
# Messages at the beginning that tell which frames there are.
_LOOKED_AT = 10_000


class RecordedTransforms:
    """What the node would know of frames when an image has waited for them.

    All static transforms count from the beginning. Of the others, what was recorded up to
    `timeout` after an image is known to it, as the node waits that long.

    Parameters
    ----------
    path : Path
        Of the recording.
    timeout : float
        Seconds; the parameter `tf_timeout`.
    """

    def __init__(self, path: Path, timeout: float) -> None:
        self._recording = Recording(path)
        self._timeout = round(timeout * 1e9)
        self._buffer = TransformBuffer()
        self._messages = self._read()
        self._next = next(self._messages, None)

    def __enter__(self) -> RecordedTransforms:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._recording.close()

    def lookup(self, target: str, source: str, stamp: int, time: int) -> Transform:
        """As `TransformBuffer.lookup`, for an image recorded at `time`, nanoseconds."""
        self._advance(time + self._timeout)
        return self._buffer.lookup(target, source, stamp)

    def _advance(self, time: int) -> None:
        """Take in what was recorded up to a time."""
        while self._next and self._next[0] <= time:
            insert_transforms(self._buffer, self._next[1], static=False)
            self._next = next(self._messages, None)

    def _read(self) -> Iterator[tuple[int, Any]]:
        try:
            for _, _, message in self._messages_on(STATIC):
                insert_transforms(self._buffer, message, static=True)
            for _, time, message in self._messages_on(MOVING):
                yield time, message
        # The damage is told by whoever reads the images. Up to it all is used.
        except Exception:
            return

    def _messages_on(self, topic: str) -> Iterator[tuple[str, int, Any]]:
        if self._recording.types.get(topic) in TYPES:
            for name, time, message in self._recording.messages([topic]):
                if not isinstance(message, Lost):
                    yield name, time, message


def fixed_frame_of(path: Path) -> str:
    """Frame in which the tf of a recording moves: above all others, and not only statically.

    Of several `map` counts before `odom` and `world`; empty where nothing moves.
    """
    parents: dict[str, str] = {}
    moving: set[str] = set()
    with closing(Recording(path)) as recording:
        topics = [t for t in (MOVING, STATIC) if recording.types.get(t) in TYPES]
        for topic, _, message in islice(recording.messages(topics) if topics else (), _LOOKED_AT):
            for one in getattr(message, 'transforms', ()):
                child = one.child_frame_id.removeprefix('/')
                parents[child] = one.header.frame_id.removeprefix('/')
                moving |= {child} if topic == MOVING else set()
    found = set()
    for frame in moving:
        above = [frame]
        while above[-1] in parents and parents[above[-1]] not in above:
            above.append(parents[above[-1]])
        found.add(above[-1])
    order = ['map', 'odom', 'world', *sorted(found)]
    return next((name for name in order if name in found), '')
