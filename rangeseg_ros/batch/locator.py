"""Where the camera was at the frames of a recording."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.placement import Placement, find_placement
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.io.transforms import RecordedTransforms
from rangeseg_ros.messages.frames import DepthFrame


class Locator:
    """What tf told of the camera at each frame of a recording.

    Attributes
    ----------
    problems : Counter
        Which frame of the parameters is not known, and why -> number of images.
    last : Placement
        Of the last frame.
    """

    def __init__(self, recording: Path, config: Config) -> None:
        self._config = config
        self._recorded = RecordedTransforms(recording, config.tf_timeout)
        self.problems: Counter[str] = Counter()
        self.last = Placement()

    def __enter__(self) -> Locator:
        return self

    def __exit__(self, *exception: object) -> None:
        self._recorded.close()

    def place(self, frame: DepthFrame) -> Placement:
        """Where the camera was."""

        def lookup(target: str, source: str) -> Transform:
            return self._recorded.lookup(target, source, frame.stamp, frame.time)

        self.last = found = find_placement(self._config, frame.frame_id, lookup)
        self.problems.update(f'{what} {why}' for what, why in found.missing.items())
        return found
