"""What planes are to a robot: floor, ceiling, wall, table, by the direction that is up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane

ROLES = ('other', 'floor', 'ceiling', 'wall', 'table')
"""All roles; their indices are their numbers in messages."""


class RolesError(ValueError):
    """A direction that points nowhere."""


def roles(planes: Sequence[Plane], config: Config, up: ArrayLike | None = None) -> list[str]:
    """Role of each plane.

    A plane is horizontal when its normal is within `role_tolerance` of up (facing up) or down
    (facing down), vertical when it is within `role_tolerance` of a right angle to it. The size
    of a plane is that of its surface, so that all parts of a floor count together.

    - floor: of the large surfaces facing up the one farthest below the sensor, and all that face
      up and continue it within `role_height`
    - table: other planes facing up, of any size, that lie above the floor
    - ceiling: of the large surfaces facing down the one farthest above the sensor, and all that
      face down and continue it within `role_height`
    - wall: large vertical planes
    - other: the rest

    Without a floor in sight the lowest large table takes its place: a single image does not tell
    them apart.

    Parameters
    ----------
    planes : sequence of Plane
        Of one image.
    config : Config
        `role_tolerance`, `role_height`, `role_area`: the area from which a surface is large; and
        `up_x`, `up_y`, `up_z`.
    up : (3,) float, optional
        Direction, of any length, in the frame of the image; the configured one when not given.

    Raises
    ------
    RolesError
        `up` is zero, not finite or not a vector.
    """
    if not planes:
        return []
    up = unit((config.up_x, config.up_y, config.up_z) if up is None else up)
    normal = np.array([plane.normal for plane in planes])
    rise = np.degrees(np.arcsin(np.clip(normal @ up, -1, 1)))
    upward, downward = (s * rise >= 90 - config.role_tolerance for s in (1, -1))
    _, surface = np.unique([plane.surface for plane in planes], return_inverse=True)
    area = np.array([plane.area for plane in planes])
    large = np.bincount(surface, area)[surface] >= config.role_area

    found = np.full(len(planes), 'other', dtype='<U7')
    found[large & (np.abs(rise) <= config.role_tolerance)] = 'wall'
    for facing, role in ((upward, 'floor'), (downward, 'ceiling')):
        offset = _before_farthest(planes, facing & large)
        found[facing & (np.abs(offset) <= config.role_height)] = role
        if role == 'floor':
            found[facing & (offset > config.role_height)] = 'table'
    return [str(role) for role in found]


def unit(direction: ArrayLike) -> NDArray[np.float64]:
    """`direction` (3,) as a unit vector; RolesError where it points nowhere."""
    vector = np.asarray(direction, np.float64)
    length = np.linalg.norm(vector)
    if vector.shape != (3,) or not np.isfinite(length) or length == 0:
        raise RolesError(f'up must be a direction (x, y, z), not {direction!r}')
    return vector / length


def _before_farthest(
    planes: Sequence[Plane], candidates: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """(N,) distance of the planes' centroids from the candidate farthest from the sensor.

    In metres, positive towards the sensor; all NaN without a candidate. A surface is as far as
    the largest of its parts.
    """
    largest: dict[int, Plane] = {}
    for plane, candidate in zip(planes, candidates, strict=True):
        if candidate and plane.area > getattr(largest.get(plane.surface), 'area', 0):
            largest[plane.surface] = plane
    if not largest:
        return np.full(len(planes), np.nan)
    farthest = max(largest.values(), key=lambda plane: plane.distance)
    return np.array([p.centroid for p in planes]) @ farthest.normal + farthest.distance
