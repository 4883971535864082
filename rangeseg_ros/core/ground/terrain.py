"""What the pixels of an image are to a robot: ground, in the way, or below.

One estimate of the ground under the robot (`estimate`), one reachability (`reach`), the ground
continued (`field`), and heights above it.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.cells import WINDOW, Cells, CellSize, axes_of, cells_of
from rangeseg_ros.core.ground.classes import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.ground.estimate import HIGHEST, Continuation, Stand, continued
from rangeseg_ros.core.ground.field import GroundField, classify, ground_field
from rangeseg_ros.core.ground.reach import Passable, reach
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

# Standard deviations of the noise within which the ground is the ground, and beyond which it is
# known to be none.
_CERTAIN = 3.0
_SQUARE = np.ones((5, 5), np.uint8)
SURE = 0.99
"""Confidence from which on the ground is the ground; less is unknown."""
FURNITURE = 1.5
"""Metres: what is longer, along or across the view, is no table (without a stated height)."""


class Limits(NamedTuple):
    """What is ground.

    Attributes
    ----------
    slope : float
        Steepest ground, radians.
    obstacle : float
        What stands so high is an obstacle, metres.
    drop : float
        What lies so deep is a drop, metres.
    tilt : float
        Standard deviation of the direction that is up, radians.
    gap, radius : float
        See `Passable`.
    """

    slope: float
    obstacle: float
    drop: float
    tilt: float = float(np.radians(Config().up_sd))
    gap: float = Config().ground_gap
    radius: float = Config().robot_radius

    @property
    def least(self) -> float:
        """The least step that is none of the ground, metres."""
        return min(self.obstacle, self.drop)


class CellTerrain(NamedTuple):
    """What the cells of an image are, (rows, columns), with the nearest row first.

    Attributes
    ----------
    place : (3, ...) float32
        See `Cells`.
    height : (...) float32
        Above the ground, metres; NaN where not measured.
    kind : (...) int8
        See `classes`.
    error : (...) float32
        See `Cells`.
    crossing : (2, ...) float32
        Where the ray crosses the ground continued, on the axes of `place`; NaN where it does not.
    """

    place: NDArray[np.float32]
    height: NDArray[np.float32]
    kind: NDArray[np.int8]
    error: NDArray[np.float32]
    crossing: NDArray[np.float32]


class Terrain(NamedTuple):
    """What the pixels of an image are to a robot.

    Attributes
    ----------
    classes : (H, W) uint8
        See `classes`.
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
    height: NDArray[np.float32]
    stand: Stand
    field: GroundField
    cells: CellTerrain | None = None

    def __str__(self) -> str:
        """Where the ground is and how sure that is, in a few words."""
        if not self.stand.found:
            return '; '.join(['no ground in view', *self.stand.reasons])
        height, confidence = self.stand.height(self.field.up), self.stand.confidence
        return f'ground {height:.2f} m below, confidence {confidence:.2f}'


def terrain_of(
    image: RangeImage,
    sensor: SensorModel,
    up: NDArray[np.float64],
    known: tuple[float, float],
    limits: Limits,
) -> Terrain:
    """Class and height of every pixel.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    sensor : SensorModel
    up : (3,) float64
        Unit vector in the frame of the image.
    known : (float, float)
        Height of the camera above the ground below it and its standard deviation, metres; 0, 0
        when nothing is known.
    limits : Limits
    """
    right, down, _ = up @ image.axes
    if abs(right) <= abs(down):
        return _upright(image, sensor, up, known, limits, bool(down > 0))
    # A camera on its side: columns are along up in the image with rows and columns exchanged.
    rays = np.ascontiguousarray(image.rays.transpose(1, 0, 2))
    rays.flags.writeable = False  # as all rays are, or every kernel is compiled twice
    turned = RangeImage(rays, np.ascontiguousarray(image.inverse.T))
    found = _upright(turned, sensor, up, known, limits, bool(right > 0))
    return found._replace(
        classes=np.ascontiguousarray(found.classes.T),
        height=np.ascontiguousarray(found.height.T),
        field=found.field.turned(),
    )


def _upright(
    image: RangeImage,
    sensor: SensorModel,
    up: NDArray[np.float64],
    known: tuple[float, float],
    limits: Limits,
    turned: bool,
) -> Terrain:
    """The same for an image whose columns are along up; `turned` where up is down in it."""
    size = CellSize.for_image(image.shape)
    cells = cells_of(image, size, up, sensor)
    place, variance = cells.place.astype(np.float64), cells.variance
    height, height_sd = known
    height = height or _nearest(place[0, :: 1 if turned else -1])
    place[0] += height
    slope = float(np.tan(limits.slope))
    passable = Passable(limits.least, slope, limits.gap, limits.radius)
    found = None
    # Where nothing is near the stated height, what is elsewhere tells how wrong that is.
    for highest in (HIGHEST, np.inf) if height_sd > 0 else (np.inf,):
        reached = reach(place, variance, cells.shared, highest, passable, turned)
        if reached.any():
            near = place[:, reached], 4 * variance[reached]
            found = continued(*near, height_sd, slope, limits.least)
            break
    # Without a height the ground is what the camera stands on: a table tells by its size.
    if not found or (found.confidence < SURE if height_sd > 0 else found.size < FURNITURE):
        return _without_ground(image, cells, size, found, up, known, limits)
    a, b, c = found.plane
    lean = np.array([b, c]) @ axes_of(up)[1:]
    stand = Stand(-(up - lean) / (height - a), found.confidence)
    return _with_ground(image, cells, size, reached, stand, up, limits, turned)


def _nearest(above: NDArray[np.float64]) -> float:
    """How far below the sensor the nearest cells are, metres, where no height is stated."""
    nearest = above[np.isfinite(above).argmax(axis=0), np.arange(above.shape[1])]
    return max(-float(np.nanmedian(nearest)), 0.02) if np.isfinite(nearest).any() else 1.0


def _with_ground(
    image: RangeImage,
    cells: Cells,
    size: CellSize,
    reached: NDArray[np.bool_],
    stand: Stand,
    up: NDArray[np.float64],
    limits: Limits,
    turned: bool,
) -> Terrain:
    """Classes and heights by the ground that was reached, continued.

    More than seven parameters: all that was found on the way.
    """
    field = ground_field(cells, reached, stand.theta, size, up)
    height = field.heights(cells)
    # Relief counts as noise: what the cells of the ground scatter by.
    count = cv2.blur(reached.astype(np.float32), (WINDOW, WINDOW))
    squares = cv2.blur(np.where(reached, height, 0) ** 2, (WINDOW, WINDOW))
    with np.errstate(divide='ignore', invalid='ignore'):
        relief = np.where(count > 0, squares / count, 0)
    noise = np.float32(_CERTAIN) * np.sqrt(cells.error**2 + relief, dtype=np.float32)
    # Among cells that a chain leads to, noise keeps some out of it.
    closed = cv2.morphologyEx(reached.view(np.uint8), cv2.MORPH_CLOSE, _SQUARE)
    reached, beside = closed > 0, cv2.dilate(closed, _SQUARE[1:-1, 1:-1]) > 0
    # Where no chain leads, half as much is no ground.
    share = np.where(reached, np.float32(1), np.float32(0.5))
    sure = np.float32(_CERTAIN) * cells.error
    bounds = np.empty((3, *reached.shape), np.float32)
    bounds[0] = np.where(beside, np.clip(noise, limits.least / 4, share * limits.least), -1)
    bounds[1] = -np.maximum(share * limits.drop, sure)
    bounds[2] = np.maximum(share * limits.obstacle, sure)
    classes, heights = classify(image, field, bounds)
    kind = np.where(reached & np.isfinite(height), GROUND, UNKNOWN).astype(np.int8)
    kind[height > bounds[2]] = OBSTACLE
    kind[height < bounds[1]] = DROP
    along = (field.theta * cells.ray).sum(axis=0)
    with np.errstate(divide='ignore', invalid='ignore'):
        flat_axes = axes_of(up)[1:].astype(np.float32)
        along[along <= 0] = np.nan
        crossing: NDArray[np.float32] = np.tensordot(flat_axes, cells.ray, 1) / along
    order = slice(None, None, 1 if turned else -1)
    below = CellTerrain(
        cells.place[:, order], height[order], kind[order], cells.error[order], crossing[:, order]
    )
    return Terrain(classes, heights, stand, field, below)


def _faces(cells: Cells, limits: Limits) -> NDArray[np.bool_]:
    """Cells (rows, columns) of surfaces that rise more steeply than any ground."""
    steep = np.zeros(cells.inverse.shape, np.bool_)
    if len(steep) < 3:
        return steep
    rise = np.abs(cells.place[0, 2:] - cells.place[0, :-2])
    way = np.hypot(*(cells.place[1:, 2:] - cells.place[1:, :-2]))
    noise = np.float32(2**0.5 * _CERTAIN) * cells.error[1:-1]
    # Three times as steep as any ground, as what is hidden behind an edge is not.
    steep[1:-1] = rise > 3 * np.tan(limits.slope) * way + noise
    steep[0], steep[-1] = steep[1], steep[-2]
    return steep


def _without_ground(
    image: RangeImage,
    cells: Cells,
    size: CellSize,
    seen: Continuation | None,
    up: NDArray[np.float64],
    known: tuple[float, float],
    limits: Limits,
) -> Terrain:
    """No ground that is sure: obstacles are what is above where it can be, the rest unknown."""
    height, height_sd = known
    reasons: tuple[str, ...] = ()
    obstacle = _faces(cells, limits)
    if height > 0:
        # What is higher than any step is none, nor the ground by a wrong height.
        apart = abs(seen.plane[0]) if seen and seen.plane[0] < HIGHEST else 0.0
        distance = np.hypot(cells.place[1], cells.place[2])
        bound = limits.obstacle + apart + _CERTAIN * (height_sd + limits.tilt * distance)
        obstacle |= cells.place[0] + height > bound
    wide = size.enlarged(obstacle, image.shape)
    classes = np.where(image.valid & wide, OBSTACLE, UNKNOWN).astype(np.uint8)
    if seen and height > 0:
        off, below = abs(seen.plane[0]), height - seen.plane[0]
        why = f'the stated height is {height:.2f} m, the ground seen is {below:.2f} m below'
        if off > _CERTAIN * seen.error:
            why += f', {off / seen.error:.0f} sd: a step or ramp out of view, or a wrong height'
        else:
            why += f' +- {seen.error:.2f} m: a step out of view would not be noticed'
        reasons = (why,)
    elif height > 0:
        reasons = (f'no ground that is seen is {height:.2f} m below, as is known',)
    elif seen:
        reasons = (f'without sensor_height, what is below {FURNITURE:g} m long may be a table',)
    confidence = seen.confidence if seen and height > 0 else 0.0
    nowhere = GroundField(np.zeros((3, *cells.inverse.shape), np.float32), size, up)
    stand = Stand(np.zeros(3), confidence, reasons)
    return Terrain(classes, np.full(image.shape, np.nan, np.float32), stand, nowhere)
