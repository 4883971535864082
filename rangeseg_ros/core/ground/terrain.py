"""What the pixels of an image are to a robot: ground, in the way, or below.

One estimate of the ground under the robot (`estimate`), one reachability (`reach`), the ground
continued (`ground_field`), and heights above it.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Mask, Singles
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.cells import (
    DROP,
    GROUND,
    OBSTACLE,
    UNKNOWN,
    GroundCells,
    GroundField,
    cells_of,
    classify,
    ground_field,
)
from rangeseg_ros.core.ground.estimate import HIGHEST_STEP, Continuation, Stand, continued
from rangeseg_ros.core.ground.reach import reach
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

# Standard deviations of noise: the ground errs by no more, and what errs by more is none.
_CERTAIN = 3.0
# Cells among which noise keeps some out of a chain, and over which relief is measured.
_AROUND = np.ones((5, 5), np.uint8)
SURE = 0.99
"""Least confidence with which ground counts as ground; with less, it is unknown."""
FURNITURE = 1.5
"""Metres: what is longer, along or across the view, is no table (without a stated height)."""


class CellTerrain(NamedTuple):
    """What the cells of an image are, (rows, columns), with the nearest row first.

    `place` (3, ...) and `error` (...) are those of `GroundCells`, `height` (...) above the ground,
    metres, NaN where not measured, `kind` (...) `GROUND` or another class, and `crossing` (2, ...)
    where the ray crosses the ground continued, on the axes of `place`; NaN where it does not.
    """

    place: Singles
    height: Singles
    kind: NDArray[np.int8]
    error: Singles
    crossing: Singles


class Terrain(NamedTuple):
    """What the pixels of an image are to a robot.

    Attributes
    ----------
    classes : (H, W) uint8
        See `cells.GROUND`.
    height : (H, W) float32
        Metres along up above the ground; NaN where not measured or no ground is known.
    stand : Stand
        The ground under the robot.
    field : GroundField
        The ground continued everywhere; zeros where none is known.
    cells : CellTerrain or None
        The same of cells, where ground is known.
    """

    classes: NDArray[np.uint8]
    height: Singles
    stand: Stand
    field: GroundField
    cells: CellTerrain | None = None

    def __repr__(self) -> str:
        return f'<Terrain: {self}>'

    def __str__(self) -> str:
        """Where the ground is and how sure that is, in a few words."""
        if not self.stand.found:
            return '; '.join(['no ground in view', *self.stand.reasons])
        height, confidence = self.stand.height(self.field.up), self.stand.confidence
        return f'ground {height:.2f} m below, confidence {confidence:.2f}'


def terrain_of(
    image: RangeImage, sensor: SensorModel, up: Floats, known: tuple[float, float], config: Config
) -> Terrain:
    """Class and height of every pixel.

    `up` (3,) is a unit vector in the frame of the image, `known` the height of the camera above
    the ground below it and its standard deviation, metres; 0, 0 when nothing is known.
    """
    right, down, _ = up @ image.axes
    if abs(right) <= abs(down):
        return _upright(image, sensor, up, known, config, bool(down > 0))
    # A camera on its side: columns are along up in the image with rows and columns exchanged.
    rays = np.ascontiguousarray(image.rays.transpose(1, 0, 2))
    rays.flags.writeable = False  # as all rays are, or every kernel is compiled twice
    body = None if image.body is None else image.body.T
    turned = RangeImage(rays, np.ascontiguousarray(image.inverse.T), body=body)
    found = _upright(turned, sensor, up, known, config, bool(right > 0))
    return found._replace(
        classes=np.ascontiguousarray(found.classes.T),
        height=np.ascontiguousarray(found.height.T),
        field=found.field.turned(),
    )


def _upright(
    image: RangeImage,
    sensor: SensorModel,
    up: Floats,
    known: tuple[float, float],
    config: Config,
    turned: bool,
) -> Terrain:
    """The same for an image whose columns are along up; `turned` where up is down in it."""
    cells = cells_of(image, up, sensor, turned)
    place = cells.place.astype(np.float64)
    height, height_sd = known[0] or _nearest(place[0]), known[1]
    place[0] += height
    reached = reach(place, cells.variance, config, image.body is not None)
    seen = None
    if reached.any():
        seen = continued(place[:, reached], cells.variance[reached], height_sd, config)
    if height_sd > 0:
        sure = seen is not None and seen.confidence >= SURE
        reason = _contradiction(height, seen)
    else:
        # Without a height the ground is what the camera stands on: a table tells by its size.
        size = float(np.ptp(place[1:, reached], axis=1).max()) if seen else 0.0
        sure = size >= FURNITURE
        why = f'the {size:.2f} m of level surface in view may be a table: state sensor_height'
        reason = why if size > config.least_step else ''
    if seen is None or not sure:
        confidence = seen.confidence if seen and height_sd > 0 else 0.0
        stand = Stand(np.zeros(3), confidence, (reason,) if reason else ())
        return _without_ground(image, cells, seen, stand, known, config)
    a, b, c = seen.plane
    lean = np.array([b, c]) @ cells.axes[1:]
    stand = Stand(-(up - lean) / (height - a), seen.confidence)
    return _with_ground(image, cells, reached, stand, config)


def _nearest(above: Floats) -> float:
    """How far below the sensor the nearest cells are, metres, where no height is stated."""
    nearest = above[np.isfinite(above).argmax(axis=0), np.arange(above.shape[1])]
    return max(-float(np.nanmedian(nearest)), 0.02) if np.isfinite(nearest).any() else 1.0


def _contradiction(height: float, seen: Continuation | None) -> str:
    """What a stated height, metres, and the ground that is seen say of each other."""
    if seen is None:
        return f'no ground is seen {height:.2f} m below, the height that is stated or remembered'
    off, below = abs(seen.plane[0]), height - seen.plane[0]
    why = f'the stated height is {height:.2f} m, the ground seen is {below:.2f} m below'
    if off > _CERTAIN * seen.error:
        return f'{why}, {off / seen.error:.0f} sd: a step or ramp out of view, or a wrong height'
    return f'{why} +- {seen.error:.2f} m: a step out of view would not be noticed'


def _with_ground(
    image: RangeImage, cells: GroundCells, reached: Mask, stand: Stand, config: Config
) -> Terrain:
    """Classes and heights by the ground that was reached, continued."""
    field = ground_field(cells, reached, stand.theta)
    height = field.heights(cells)
    # Relief counts as noise: what the cells of the ground scatter by.
    squares, count = (
        cv2.blur(values, _AROUND.shape)
        for values in (np.where(reached, height, 0) ** 2, reached.astype(np.float32))
    )
    relief = np.maximum(squares, 0) / np.maximum(count, np.finfo(np.float32).eps)
    sure = np.float32(_CERTAIN) * cells.error
    noise = np.float32(_CERTAIN) * np.sqrt(cells.error**2 + relief)
    # Among cells that a chain leads to, noise keeps some out of it.
    closed = cv2.morphologyEx(reached.view(np.uint8), cv2.MORPH_CLOSE, _AROUND)
    reached, border = closed > 0, cv2.dilate(closed, np.ones((3, 3), np.uint8)) > 0
    # Where no chain leads, half as much is no ground.
    share = np.where(reached, np.float32(1), np.float32(0.5))
    least = np.float32(config.least_step / 4)
    near = np.where(reached, np.clip(noise, least, config.least_step), np.where(border, least, -1))
    lowest = -np.maximum(share * config.drop_height, sure)
    highest = np.maximum(share * config.obstacle_height, sure)
    bounds = np.stack([near, lowest, highest], dtype=np.float32)
    kind = np.where(reached & np.isfinite(height), GROUND, UNKNOWN).astype(np.int8)
    kind[height > highest] = OBSTACLE
    kind[height < lowest] = DROP
    # By similar triangles: the ray to a place so high above the ground crosses it farther away.
    share = np.float32(1) + height * np.tensordot(cells.axes[0].astype(np.float32), field.theta, 1)
    share[share <= 0] = np.nan
    below = CellTerrain(cells.place, height, kind, cells.error, cells.place[1:] / share)
    field = field._replace(theta=np.ascontiguousarray(field.theta[:, cells.order]))
    return Terrain(*classify(image, field, bounds[:, cells.order]), stand, field, below)


def _without_ground(
    image: RangeImage,
    cells: GroundCells,
    seen: Continuation | None,
    stand: Stand,
    known: tuple[float, float],
    config: Config,
) -> Terrain:
    """No ground that is sure: obstacles are what is above where it can be, the rest unknown."""
    height, height_sd = known
    obstacle = _faces(cells, config)
    if height > 0:
        # What is higher than any step is none, nor the ground by a wrong height.
        apart = abs(seen.plane[0]) if seen and seen.plane[0] < HIGHEST_STEP else 0.0
        error = height_sd + np.radians(config.up_sd) * np.hypot(cells.place[1], cells.place[2])
        bound = config.obstacle_height + apart + _CERTAIN * error
        obstacle |= cells.place[0] + height > bound
    wide = cells.size.enlarged(obstacle[cells.order], image.shape)
    classes = np.where(image.valid & wide, OBSTACLE, UNKNOWN).astype(np.uint8)
    nowhere = GroundField(np.zeros((3, *obstacle.shape), np.float32), cells.size, cells.axes[0])
    return Terrain(classes, np.full(image.shape, np.nan, np.float32), stand, nowhere)


def _faces(cells: GroundCells, config: Config) -> Mask:
    """Cells (rows, columns) of surfaces that rise more steeply than any ground."""
    steep = np.zeros(cells.inverse.shape, np.bool_)
    if len(steep) < 3:
        return steep
    rise = np.abs(cells.place[0, 2:] - cells.place[0, :-2])
    way = np.hypot(*(cells.place[1:, 2:] - cells.place[1:, :-2]))
    noise = np.float32(2**0.5 * _CERTAIN) * cells.error[1:-1]
    # Three times as steep as any ground, as what is hidden behind an edge is not.
    steep[1:-1] = rise > 3 * config.steepest * way + noise
    steep[0], steep[-1] = steep[1], steep[-2]
    return steep
