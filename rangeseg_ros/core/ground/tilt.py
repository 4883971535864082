"""Whether up is where the planes say it is.

Most of what is built is level or vertical: the direction that most of the planes agree with is
up, and where the stated one is far from it, a camera is mounted otherwise than is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.significance import CLEARLY

# Largest tilt that is looked for, degrees: beyond, a floor is nearer to a wall.
_LARGEST = 45.0


class Tilt(NamedTuple):
    """A camera that stands otherwise than is said.

    Attributes
    ----------
    degrees : float
        Between the stated up and that of the planes.
    up : (3,) float64
        Of the planes, in the frame of the image.
    """

    degrees: float
    up: NDArray[np.float64]

    def __str__(self) -> str:
        """What to do about it, in one line."""
        x, y, z = (f'{part:.3f}' for part in self.up)
        return (
            f'the camera looks tilted by {self.degrees:.0f} degrees against the stated up: floor, '
            f'roles and terrain are not to be trusted; by the planes, up is ({x}, {y}, {z})'
        )


def tilt_of(
    planes: Sequence[Plane],
    up: NDArray[np.float64],
    tolerance: float,
    area: float,
    slope: float,
) -> Tilt | None:
    """The tilt that the planes show; None where they agree with `up`, or do not tell.

    Parameters
    ----------
    planes : sequence of Plane
        Of one image.
    up : (3,) float64
        Stated, unit vector in the frame of the image.
    tolerance : float
        Angle up to which planes agree with what is stated, degrees.
    area : float
        Smallest plane that shows where up is, square metres.
    slope : float
        Of a ramp that may fill the view, degrees: no tilt up to that.
    """
    normals = np.array([plane.normal for plane in planes]).reshape(-1, 3)
    pixels = np.array([plane.count for plane in planes], np.float64)
    steep = np.degrees(np.arccos(np.clip(normals @ up, -1, 1)))
    stated = _agree(normals, up, tolerance)
    found: list[tuple[float, int]] = []
    # Only what may be a floor tells: a lone slanted wall or ceiling stands in many rooms.
    for k in map(int, np.flatnonzero((steep > max(tolerance, slope)) & (steep <= _LARGEST))):
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


def _agree(
    normals: NDArray[np.float64], up: NDArray[np.float64], tolerance: float
) -> NDArray[np.bool_]:
    """Which planes are level or vertical by a direction, within `tolerance` degrees."""
    rise = np.degrees(np.arcsin(np.clip(np.abs(normals @ up), 0, 1)))
    result: NDArray[np.bool_] = (rise <= tolerance) | (rise >= 90 - tolerance)
    return result
