"""How a camera is mounted above the floor: roll, pitch and height with their errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.core.mapping.odometry import level
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.core.significance import CLEARLY, OUTLIER

# Largest angle between up and -y of the camera, so that no wall is taken for the floor.
_STEEPEST = np.radians(60.0)


class Mount(NamedTuple):
    """Where a camera is above the floor, the floor's frame below it with x forward, z up.

    Roll about the optical axis is positive where the camera's right side is lower, pitch
    downwards, radians; height is in metres, and `sigma` (3,) are standard deviations of the three.
    `rotation` takes the optical frame to the floor's; `doubts` say why the floor is not sure.
    """

    roll: float
    pitch: float
    height: float
    sigma: Floats
    rotation: Floats
    doubts: list[str]

    @property
    def quaternion(self) -> Floats:
        """x, y, z, w of `rotation`."""
        return quaternions(self.rotation)

    @property
    def rpy(self) -> Floats:
        """Angles about the fixed axes x, y, z, as URDF has them, radians."""
        angles: Floats = Rotation.from_matrix(self.rotation).as_euler('xyz')
        return angles


def mount_of(planes: Sequence[MapPlane], frames: int, tolerance: float) -> Mount | None:
    """The mount by the floor among planes that were fused in the optical frame.

    The floor is the plane that faces up with the largest area times number of observations, as the
    floor alone stays where it is when a robot drives on it. None when nothing faces up. `frames`
    is the number of frames the planes are from, `tolerance` is `role_tolerance`, degrees.
    """
    facing = [plane for plane in planes if -plane.normal[1] > np.cos(_STEEPEST)]
    weight = [plane.area * plane.observations for plane in facing]
    if not facing:
        return None
    order = np.argsort(weight)[::-1]
    floor = facing[order[0]]
    up = floor.normal
    roll, pitch = float(np.arctan2(-up[0], -up[1])), float(np.arcsin(np.clip(-up[2], -1, 1)))
    across = up[0] ** 2 + up[1] ** 2
    jacobian = np.zeros((3, 4))
    jacobian[0, :2] = up[1] / across, -up[0] / across
    jacobian[1, 2] = -1 / np.sqrt(max(1 - up[2] ** 2, 1e-12))
    jacobian[2, 3] = 1
    sigma = np.sqrt(np.diag(jacobian @ floor.covariance @ jacobian.T))
    doubts = []
    if 2 * floor.observations < frames:
        doubts.append(f'it was found in {floor.observations} of {frames} frames')
    if len(order) > 1 and CLEARLY * weight[order[1]] > weight[order[0]]:
        other = facing[order[1]]
        doubts.append(f'a plane {other.distance:.2f} m below the camera may be the floor as well')
    if OUTLIER * sigma[:2].max() > np.radians(tolerance):
        doubts.append(f'its direction is known to {np.degrees(sigma[:2].max()):.1f} degrees only')
    return Mount(roll, pitch, floor.distance, sigma, level(up, np.eye(3)), doubts)
