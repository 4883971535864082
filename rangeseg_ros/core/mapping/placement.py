"""Where a camera is and which way is up, by what frames, sensors and parameters tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.transforms import Transform, TransformError

Lookup = Callable[[str, str], Transform]
"""(target, source) -> the motion between two frames at the stamp of an image; TransformError."""

PARAMETERS = 'the parameters up_x, up_y, up_z'


@dataclass
class Placement:
    """What is known of a camera at the stamp of an image.

    `pose` and `target` take the frame of the image to `fixed_frame` and `target_frame`. `up` (3,)
    is in the frame of the image, None for that of the parameters; `height`, metres, is that of its
    origin above z = 0 of `gravity_frame`. `sources` tell what 'up', 'fixed frame' and 'target
    frame' come from, or why they are not known; `missing` why frames that parameters name are not,
    without times, and `may_come` whether they may be known later.
    """

    pose: Transform | None = None
    target: Transform | None = None
    up: NDArray[np.float64] | None = None
    height: float | None = None
    sources: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    may_come: bool = False


def find_placement(
    config: Config,
    frame: str,
    lookup: Lookup,
    acceleration: tuple[str, NDArray[np.float64]] | None = None,
) -> Placement:
    """Look up what the parameters ask for at an image in `frame`.

    Up is that of `gravity_frame`; where it is not known, that of an accelerometer at rest, its
    frame and measurement (3,), whatever frame it is, or else that of the parameters.
    """
    found = Placement()

    def ask(what: str, target: str, source: str = frame) -> Transform | None:
        try:
            motion = Transform.identity() if target == source else lookup(target, source)
        except TransformError as error:
            found.sources[what] = f'{target}: {error}'
            found.missing[what] = f'{target}: {error.reason}'
            # An accelerometer is asked at once, and for what it says at once.
            found.may_come |= error.may_come and source == frame
            return None
        found.sources[what] = target
        return motion

    if config.fixed_frame:
        found.pose = ask('fixed frame', config.fixed_frame)
    if config.target_frame:
        found.target = ask('target frame', config.target_frame)
    if config.gravity_frame and (motion := ask('up', config.gravity_frame)):
        found.up, found.height = motion.rotation[2], float(motion.shift[2])
        return found
    why = found.sources.pop('up', '')
    tried = [f'no {why}'] if why else []
    if acceleration:
        if motion := ask('up', frame, acceleration[0]):
            found.up = motion.rotation @ acceleration[1]
            found.sources['up'] = '; '.join([f'imu in {acceleration[0]}', *tried])
            return found
        found.missing['up'] = why = f'imu in {acceleration[0]}: {found.sources.pop("up")}'
        tried.append(f'no {why}')
    found.sources['up'] = '; '.join([PARAMETERS, *tried])
    return found


class HeldUp:
    """The last direction that was known to be up: a camera on a robot keeps it for seconds."""

    def __init__(self) -> None:
        self._last: tuple[int, NDArray[np.float64], float | None] | None = None

    def hold(self, found: Placement, stamp: int, patience: float) -> str:
        """Where up is not known, take the last one; why there is none, or empty.

        The up and height of what was `found` at a stamp, nanoseconds, are set to those known up to
        `patience` seconds before.
        """
        if found.up is not None:
            self._last = stamp, found.up, found.height
            return ''
        why = found.sources.get('up', '')
        if self._last is not None:
            then, up, height = self._last
            age = (stamp - then) / 1e9
            if 0 <= age <= patience:
                found.up, found.height = up, height
                found.sources['up'] = f'held for {age:.1f} s: {why}'
                return ''
        return f'no terrain, as up is not known: {why}'
