"""Whether a camera stands as is said: which way planes say up is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Floats, Mask
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.significance import CLEARLY


class Tilt(NamedTuple):
    """A camera that stands otherwise than is said, by the up (3,) of the planes."""

    degrees: float
    up: Floats

    def __str__(self) -> str:
        """What to do about it, in one line."""
        x, y, z = (f'{part:.3f}' for part in self.up)
        return (
            f'up as stated, or of a level camera, is off by {self.degrees:.0f} degrees, so that '
            f'roles and terrain are unreliable; the planes say up_x: {x}, up_y: {y}, up_z: {z}'
        )


def tilt_of(
    planes: Sequence[Plane], up: Floats, tolerance: float, area: float, slope: float
) -> Tilt | None:
    """The tilt that the planes show; None where they agree with `up`, or do not tell.

    Most of what is built is level or vertical, within `tolerance` degrees: the normal that most of
    the planes agree with is up, of planes of at least `area` square metres. A ramp of up to
    `slope` degrees may fill the view.
    """
    normals = np.array([plane.normal for plane in planes]).reshape(-1, 3)
    pixels = np.array([plane.count for plane in planes], np.float64)
    steep = np.degrees(np.arccos(np.clip(normals @ up, -1, 1)))
    stated = _agree(normals, up, tolerance)
    found: list[tuple[float, int]] = []
    # Only what may be a floor tells: a lone slanted wall or ceiling stands in many rooms. What
    # leans by more than 45 degrees is nearer to a wall.
    for k in map(int, np.flatnonzero((steep > max(tolerance, slope)) & (steep <= 45))):
        seen = _agree(normals, normals[k], tolerance)
        # Walls that the camera would turn about agree with both.
        alone = pixels[seen & ~stated].sum(), pixels[stated & ~seen].sum()
        whole = 2 * pixels[seen].sum() >= pixels.sum()  # most of what is seen
        # The area last: it is worked out when asked for.
        if whole and alone[0] > CLEARLY * alone[1] and planes[k].area >= area:
            found.append((float(alone[0]), k))
    if not found:
        return None
    floor = max(found)[1]
    return Tilt(float(steep[floor]), normals[floor].astype(np.float64))


def _agree(normals: Floats, up: Floats, tolerance: float) -> Mask:
    """Which planes are level or vertical by a direction, within `tolerance` degrees."""
    rise = np.degrees(np.arcsin(np.clip(np.abs(normals @ up), 0, 1)))
    result: Mask = (rise <= tolerance) | (rise >= 90 - tolerance)
    return result
