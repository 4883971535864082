"""Where a camera is and which way is up, by what frames, sensors and parameters tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.description.shapes import Shape
from rangeseg_ros.core.mapping.map_planes import MapOutline
from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.core.rotations import quaternions, rotation_matrix
from rangeseg_ros.core.tracking.plane_errors import moved_plane

Lookup = Callable[[str, str], Transform]
"""(target, source) -> the motion between two frames at the stamp of an image; TransformError."""

AnyPlane = TypeVar('AnyPlane', bound=Plane)

PARAMETERS = 'the parameters up_x, up_y, up_z'


@dataclass
class Placement:
    """What is known of a camera at the stamp of an image.

    Attributes
    ----------
    pose, target : Transform or None
        `fixed_frame` and `target_frame` from the frame of the image.
    up : (3,) float64 or None
        In the frame of the image; None for the parameters.
    height : float or None
        Of the origin of the frame of the image above z = 0 of `gravity_frame`, metres.
    sources : dict of str
        What 'up', 'fixed frame' and 'target frame' come from, or why they are not known.
    missing : dict of str
        Why frames that parameters name are not known, without times.
    may_come : bool
        Whether they may be known later.
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
    """Look up what the parameters ask for.

    Up is that of `gravity_frame`; where it is not known, that of an accelerometer at rest, in
    whatever frame it is, or else that of the parameters.

    Parameters
    ----------
    config : Config
        `gravity_frame`, `fixed_frame`, `target_frame`.
    frame : str
        Of the image.
    lookup : callable
    acceleration : (str, (3,) float64), optional
        Frame and measurement of an accelerometer.
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

        Parameters
        ----------
        found : Placement
            Of an image; its up and height are set.
        stamp : int
            When the image was taken, nanoseconds.
        patience : float
            Seconds for which the last one holds.
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


def moved_planes(planes: Sequence[AnyPlane], motion: Transform) -> list[AnyPlane]:
    """Planes in the frame that `motion` leads to; normals stay on the side of the sensor."""
    turn, shift = motion
    jacobian = moved_plane(turn, shift)
    moved = []
    for plane in planes:
        normal = turn @ plane.normal
        outline = MapOutline(plane.outline.parts).moved(lambda ring: ring @ turn.T + shift)
        moved.append(
            replace(
                plane,
                normal=normal,
                distance=float(plane.distance - normal @ shift),
                covariance=jacobian @ plane.covariance @ jacobian.T,
                centroid=turn @ plane.centroid + shift,
                shape=Shape(
                    area=plane.area,
                    extents=plane.extents,
                    centre=turn @ plane.centre + shift,
                    orientation=quaternions(turn @ rotation_matrix(plane.orientation)),
                ),
                outline=outline,  # type: ignore[arg-type]
            )
        )
    return moved
