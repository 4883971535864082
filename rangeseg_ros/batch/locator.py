"""Where the camera was at the frames of a recording."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.placement import Placement, UpFilter, find_placement
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.io.transforms import RecordedTransforms
from rangeseg_ros.messages.frames import DepthFrame


class Locator(RecordedTransforms):
    """What tf told of the camera at each frame of a recording.

    `last` is the placement of the last frame; `problems` counts which frame of the parameters is
    not known, and why.
    """

    def __init__(self, recording: Path, config: Config) -> None:
        super().__init__(recording, config.tf_timeout)
        self._config = config
        self.problems: Counter[str] = Counter()
        self.last = Placement()
        self._up = UpFilter()

    def place(self, frame: DepthFrame, motion: Motion | None = None) -> Placement:
        """Where the camera was; `motion` is that up to the frame before."""

        def lookup(target: str, source: str) -> Transform:
            return self.lookup(target, source, frame.stamp, frame.time)

        found = find_placement(self._config, frame.frame_id, lookup)
        self.problems.update(f'{what} {why}' for what, why in found.missing.items())
        self.last = self._up.settle(found, frame.stamp, self._config, motion)
        return self.last
