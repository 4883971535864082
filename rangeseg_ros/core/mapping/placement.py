"""Where a camera is and which way is up, by what frames, sensors and parameters tell."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.core.rotations import rotation_by
from rangeseg_ros.core.significance import CLEARLY, chi2_quantile

Lookup = Callable[[str, str], Transform]
"""(target, source) -> the motion between two frames at the stamp of an image; TransformError."""

PARAMETERS = 'the parameters up_x, up_y, up_z'

AT_REST = 0.1
"""Relative difference to standard gravity below which an acceleration counts as that of rest."""

# Squared angle between two directions, in variances, that is no chance: an error about two axes.
_CONTRADICTION = chi2_quantile(2)


class Up(NamedTuple):
    """A direction (3,) that is up, in the frame of an image, and what tells it.

    `sd` is its standard deviation about either axis across it, degrees.
    """

    direction: Floats
    sd: float
    source: str


@dataclass
class Placement:
    """What is known of a camera at the stamp of an image.

    `pose` and `target` take the frame of the image to `fixed_frame` and `target_frame`. `ups` are
    all directions that are given as up, and `asked` whether any is asked for. `up` (3,), a unit
    vector in the frame of the image with the standard deviation `up_sd`, degrees, is what
    `UpFilter` makes of them: None for that of the parameters, or where `lost` says why it is not
    known. `height`, metres, is that of the image's origin above z = 0 of `gravity_frame`.
    `sources` tell what 'up', 'fixed frame' and 'target frame' come from, or why they are not
    known; `missing` why frames that parameters name are not, without times, and `may_come` whether
    they may be known later.
    """

    pose: Transform | None = None
    target: Transform | None = None
    ups: list[Up] = field(default_factory=list)
    asked: bool = False
    up: Floats | None = None
    up_sd: float | None = None
    lost: str = ''
    height: float | None = None
    sources: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    may_come: bool = False


def find_placement(
    config: Config, frame: str, lookup: Lookup, acceleration: tuple[str, Floats] | None = None
) -> Placement:
    """Look up what the parameters ask for at an image in `frame`.

    Up is given by `gravity_frame` and by the `acceleration` of an accelerometer at rest, its frame
    and measurement (3,).
    """
    found = Placement(asked=bool(config.gravity_frame) or acceleration is not None)

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
    tried = []
    if config.gravity_frame:
        if motion := ask('up', config.gravity_frame):
            found.ups.append(Up(motion.rotation[2], config.up_sd, config.gravity_frame))
            found.height = float(motion.shift[2])
        else:
            tried.append(f'no {found.sources["up"]}')
    if acceleration:
        if motion := ask('up', frame, acceleration[0]):
            measured = motion.rotation @ acceleration[1]
            # Accelerations of up to so much of gravity, evenly spread, pass for rest.
            sd = math.hypot(config.up_sd, math.degrees(AT_REST / math.sqrt(3)))
            upwards = measured / np.linalg.norm(measured)
            found.ups.append(Up(upwards, sd, f'imu in {acceleration[0]}'))
        else:
            imu = f'imu in {acceleration[0]}'
            found.missing['up'] = f'{imu}: {found.missing["up"]}'
            tried.append(f'no {imu}: {found.sources["up"]}')
    names = ' and '.join(up.source for up in found.ups)
    found.sources['up'] = '; '.join([names or PARAMETERS, *tried])
    return found


class UpFilter:
    """Up by all that gives it; while nothing does, the last one, with an error that grows.

    It turns as the planes say that the camera has turned, where the odometry follows these.
    """

    _last: tuple[int, Up, float | None] | None = None
    _motion: Motion | None = None  # of the frame whose up was given last
    _before = 0  # stamp of the last frame

    def settle(
        self, found: Placement, stamp: int, config: Config, motion: Motion | None = None
    ) -> Placement:
        """What was `found` at a stamp, nanoseconds, with its up, or why that is lost.

        What is given is weighted by its precision. It is lost where two directions contradict each
        other, and where the steepest ground may be level as well. `motion` is that of the camera
        up to the last frame.
        """
        if not found.asked:
            return found
        if motion is None or (self._last and self._last[0] == self._before):
            self._motion = motion
        since, self._before = (stamp - self._before) / 1e9, stamp
        why = _contradiction(found.ups)
        if found.ups and not why:
            weight = np.array([up.sd**-2 for up in found.ups])
            direction = weight @ [up.direction for up in found.ups]
            direction /= np.linalg.norm(direction)
            sd = found.ups[0].sd if len(weight) == 1 else float(weight.sum() ** -0.5)
            self._last = stamp, Up(direction, sd, found.sources['up']), found.height
            return replace(found, up=direction, up_sd=sd)
        why = why or found.sources['up'].removeprefix(f'{PARAMETERS}; ')
        if self._last is not None and not found.ups:
            then, up, height = self._last
            age, by, direction = (stamp - then) / 1e9, '', up.direction
            error = config.up_drift * age
            if motion and self._motion:
                turned, open_ = _turned(direction, self._motion, motion, since)
                if (less := math.hypot(open_, config.up_drift * since)) <= error:
                    direction, error, by = turned, less, ' by planes'
            sd = math.hypot(up.sd, error)
            if age >= 0 and CLEARLY * sd <= config.ground_slope:
                held = f'held{by} for {age:.1f} s, +- {sd:.1f} degrees: {why}'
                sources = found.sources | {'up': held}
                return replace(found, up=direction, up_sd=sd, height=height, sources=sources)
        return replace(found, lost=f'no terrain, as up is not known: {why}')


def _turned(up: Floats, before: Motion, now: Motion, since: float) -> tuple[Floats, float]:
    """A direction (3,) some seconds later, and its standard deviation by the way, degrees.

    Per axis across it: the covariance of the odometry grows by what planes leave open.
    """
    fixed = before.pose.rotation @ up
    more = (now.covariance - before.covariance)[3:, 3:]
    variance = max(float(np.trace(more) - fixed @ more @ fixed) / 2, 0.0)
    turned = rotation_by(-since * now.velocity[3:]) @ now.pose.rotation.T @ fixed
    return turned, math.degrees(math.sqrt(variance))


def _contradiction(ups: Sequence[Up]) -> str:
    """Which two directions differ by more than their errors; empty where none do."""
    for one, other in combinations(ups, 2):
        angle = math.degrees(math.acos(np.clip(one.direction @ other.direction, -1, 1)))
        sd = math.hypot(one.sd, other.sd)
        if angle > math.sqrt(_CONTRADICTION) * sd:
            names = f'{one.source} and {other.source}'
            return f'{names} are {angle:.0f} degrees apart, {angle / sd:.0f} sd'
    return ''
