"""What planes are to a robot: floor, ramp, step, table, wall."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rangeseg_ros.core.arrays import Floats, Mask
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.ground.stairs import RISE

ROLES = ('other', 'floor', 'ceiling', 'wall', 'table', 'ramp', 'step', 'lower')
"""All roles; their indices are their numbers in messages."""


class RolesError(ValueError):
    """A direction that points nowhere."""


def roles(planes: Sequence[Plane], config: Config, up: ArrayLike | None = None) -> list[str]:
    """Role of each plane of an image.

    A plane is horizontal when its normal is within `role_tolerance` of up (facing up) or down
    (facing down), vertical when it is within `role_tolerance` of a right angle to it. A surface is
    large from the area `role_area` on, and all parts of a floor count together.

    - floor: the large surface facing up at `sensor_height` below the sensor, within
      `role_height`; without a height, the one that reaches nearest to below the sensor; and all
      that face up and continue it within `role_height`
    - ramp: planes that rise or fall from the floor, by no more than `ground_slope` against it
    - step: other planes facing up that lie no more than a step, 0.24 m, above the floor
    - table: planes facing up that lie higher
    - lower: planes facing up that lie below the floor
    - ceiling: of the large surfaces facing down the one farthest above the sensor, and all that
      face down and continue it within `role_height`
    - wall: large vertical planes
    - other: the rest

    `up` (3,), of any length, in the frame of the image, is the configured one when not given;
    RolesError where it is zero, not finite or not a vector.
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
    high = _largest(planes, downward & large)
    if high:
        offset = _offsets(planes, max(high, key=lambda plane: plane.distance))
        found[downward & (np.abs(offset) <= config.role_height)] = 'ceiling'
    floor = _floor(_largest(planes, upward & large), up, config)
    if floor:
        offset = _offsets(planes, floor)
        found[upward] = 'step'
        found[upward & (offset > RISE[1])] = 'table'
        found[upward & (offset < -config.role_height)] = 'lower'
        found[upward & (np.abs(offset) <= config.role_height)] = 'floor'
        slope = np.degrees(np.arccos(np.clip(normal @ floor.normal, -1, 1)))
        ramp = (slope > 2 * config.up_sd) & (slope <= config.ground_slope)
        for k in map(int, np.flatnonzero(ramp)):
            off = np.abs(planes[k].corners @ floor.normal + floor.distance)
            if off.min() <= config.role_height:
                found[k] = 'ramp'
    return [str(role) for role in found]


def unit(direction: ArrayLike) -> Floats:
    """`direction` (3,) as a unit vector; RolesError where it points nowhere."""
    vector = np.asarray(direction, np.float64)
    length = np.linalg.norm(vector)
    if vector.shape != (3,) or not np.isfinite(length) or length == 0:
        raise RolesError(f'up must be a direction (x, y, z), not {direction!r}')
    return vector / length


def _floor(candidates: list[Plane], up: Floats, config: Config) -> Plane | None:
    """The floor, by where planes meet the vertical through the sensor or how near they reach."""
    if config.sensor_height > 0:

        def off(plane: Plane) -> float:
            return abs(float(plane.distance / (plane.normal @ up)) - config.sensor_height)

        nearest = min(candidates, key=off, default=None)
        return nearest if nearest and off(nearest) <= config.role_height else None

    def reach(plane: Plane) -> float:
        depth = -plane.corners @ up
        across = np.linalg.norm(plane.corners + depth[:, None] * up, axis=1)
        return float((across / np.maximum(depth, 1e-3)).min())

    return min(candidates, key=reach, default=None)


def _largest(planes: Sequence[Plane], chosen: Mask) -> list[Plane]:
    """The largest plane of each surface that has a chosen one."""
    by_area = sorted(compress(planes, chosen), key=lambda plane: plane.area)
    return list({plane.surface: plane for plane in by_area}.values())


def _offsets(planes: Sequence[Plane], level: Plane) -> Floats:
    """(N,) distance of the planes' centroids from a plane, metres, positive towards the sensor."""
    return np.array([plane.centroid for plane in planes]) @ level.normal + level.distance


class Ramp(NamedTuple):
    """A plane with the role `ramp`, by its id.

    Its `slope` against level is in degrees, `centre` (3,) its centroid in metres in the frame of
    the image, `climb` (3,) the unit vector along it that climbs most steeply.
    """

    plane: int
    slope: float
    centre: Floats
    climb: Floats

    def __str__(self) -> str:
        """Its slope."""
        return f'ramp {self.slope:.0f} degrees'


def ramps_of(planes: Sequence[Plane], up: Floats) -> list[Ramp]:
    """The ramps among planes with roles; `up` (3,) is a unit vector in their frame."""
    found = []
    for plane in planes:
        if plane.role == 'ramp':
            rise = float(plane.normal @ up)
            along = up - rise * plane.normal
            length = float(np.linalg.norm(along))  # the sine of the slope
            slope = float(np.degrees(np.arctan2(length, rise)))
            found.append(Ramp(plane.id, slope, plane.centroid, along / length))
    return found
