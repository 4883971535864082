"""Where the camera was at the frames of a recording."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.io.transforms import RecordedTransforms
from rangeseg_ros.messages.frames import DepthFrame


class Locator:
    """Where the camera was at each frame of a recording, in the fixed frame.

    Attributes
    ----------
    problems : Counter
        Why that is not known -> number of frames.
    """

    def __init__(self, recording: Path, config: Config) -> None:
        self._fixed = config.fixed_frame
        self._recorded = RecordedTransforms(recording, config.tf_timeout)
        self.problems: Counter[str] = Counter()

    def __enter__(self) -> Locator:
        return self

    def __exit__(self, *exception: object) -> None:
        self._recorded.close()

    def pose(self, frame: DepthFrame) -> Transform | None:
        """Fixed frame from the frame of the image; None where it is not known."""
        if not self._fixed:
            return None
        try:
            return self._recorded.lookup(self._fixed, frame.frame_id, frame.stamp, frame.time)
        except TransformError as error:
            self.problems[error.reason] += 1
            return None
