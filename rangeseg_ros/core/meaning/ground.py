"""Where a robot can drive: the ground it stands on, what stands on it, and where it ends.

In the order of the steps: cells, surfaces without a step, the surface under the robot, the ground
grown from there, the ground continued everywhere, and every pixel's height above that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.meaning.beside import around, sides_of
from rangeseg_ros.core.meaning.cells import Cells, CellSize, cells_of
from rangeseg_ros.core.meaning.classes import OBSTACLE, UNKNOWN
from rangeseg_ros.core.meaning.continuity import join_cells, surfaces_of
from rangeseg_ros.core.meaning.edges import below_edges
from rangeseg_ros.core.meaning.ends import ends_of, feet_of
from rangeseg_ros.core.meaning.ground_field import (
    GroundField,
    cell_heights,
    ground_field,
    sums_of,
)
from rangeseg_ros.core.meaning.growth import grown
from rangeseg_ros.core.meaning.pixels import decide, pixels_of
from rangeseg_ros.core.meaning.seed import nearest_part
from rangeseg_ros.core.meaning.steps import BROAD, Steps, noise_of
from rangeseg_ros.core.meaning.under_robot import Stand, stand
from rangeseg_ros.core.meaning.verdicts import (
    add_level,
    level_with_ground,
    parts_of,
    set_apart,
    verdicts_of,
)
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

# Standard deviations of the noise within which the ground is the ground.
_CERTAIN = 3.0
# Share of the least obstacle or drop that no noise excuses.
_EXCUSED = 0.8


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
    """

    slope: float
    obstacle: float
    drop: float
    tilt: float = float(np.radians(Config().up_noise))


class CellTerrain(NamedTuple):
    """What the cells of an image are, (rows, columns).

    Attributes
    ----------
    place : (3, ...) float32
        See `Cells`.
    height : (...) float32
        Above the ground, metres; NaN where not measured.
    kind : (...) int8
        See `classes`.
    unsure : (...) float32
        The noise of a pixel's height, metres.
    turned : bool
        Whether up is down along the columns.
    """

    place: NDArray[np.float32]
    height: NDArray[np.float32]
    kind: NDArray[np.int8]
    unsure: NDArray[np.float32]
    turned: bool


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
    remembered : float
        How far below the camera the ground was, metres, when it is out of view; 0 for unknown.
    """

    classes: NDArray[np.uint8]
    height: NDArray[np.float32]
    stand: Stand
    field: GroundField
    cells: CellTerrain | None = None
    remembered: float = 0.0

    def __str__(self) -> str:
        """Where the ground is and how sure that is, in a few words."""
        if not self.stand.surface:
            where = f': it was {self.remembered:.2f} m below' if self.remembered else ''
            return f'no ground in view{where}'
        height, confidence = self.stand.height(self.field.up), self.stand.confidence
        doubt = '' if confidence >= 0.5 else ': it may be a table or a platform'
        return f'ground {height:.2f} m below, confidence {confidence:.2f}{doubt}'


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
        return _terrain(image, sensor, up, known, limits, bool(down > 0))
    # A camera on its side: columns are along up in the image with rows and columns exchanged.
    rays = np.ascontiguousarray(image.rays.transpose(1, 0, 2))
    rays.flags.writeable = False  # as all rays are, or every kernel is compiled twice
    turned = RangeImage(rays, np.ascontiguousarray(image.inverse.T))
    found = _terrain(turned, sensor, up, known, limits, bool(right > 0))
    return found._replace(
        classes=np.ascontiguousarray(found.classes.T),
        height=np.ascontiguousarray(found.height.T),
        field=found.field.turned(),
    )


def _terrain(
    image: RangeImage,
    sensor: SensorModel,
    up: NDArray[np.float64],
    known: tuple[float, float],
    limits: Limits,
    turned: bool,
) -> Terrain:
    """The same for an image whose columns are along up; `turned` where up is down in it."""
    size = CellSize.of(image.shape)
    cells = cells_of(image, size, up, sensor)
    noise = noise_of(cells, sensor)
    least = min(limits.obstacle, limits.drop)
    slope = float(np.tan(limits.slope + limits.tilt))
    steps = Steps.of(slope, least, noise, sensor.correlation / size.rows)
    surface, count, steep, broken, links = surfaces_of(cells, steps)
    measured = sums_of(cells, cells.inverse > 0)
    under = stand(cells, surface, count, up, sensor, known, limits.slope, limits.tilt)
    if under.surface == 0:
        return _without_ground(image, cells, size, steep, up, known, limits)
    flat = GroundField.of(under.theta[None, None], size, up)
    height = cell_heights(cells, flat, size)
    start = nearest_part(height, cells.place, surface, under.surface, steps.least)
    own = surface == under.surface
    lower = below_edges(height, cells, steps, steep, broken, turned)
    fallen = lower & own
    # The top of a step may hang together with the ground beside it just as well as the bottom.
    risen = below_edges(height, cells, steps, steep, broken, turned, True) & own & ~fallen
    own &= ~(fallen | risen)
    ground = grown(height, cells, own, start & own, steps)
    # What remains is judged surface by surface, by its height beside the ground.
    plane = under.theta
    field, height = _continued(cells, ground, measured, plane, size, up)
    # A trench would hang together with the ground beyond it where noise hides its far edge.
    part = parts_of(lower, risen, steep, ground)
    # The noise of a pixel: by the sensor model, and what the image shows if that is more.
    unsure = np.float32(_CERTAIN * max(noise[BROAD], 1.0)) * cells.error
    near = around(ground)
    for _ in range(2):
        surface, count = join_cells(links, part)
        sides = sides_of(height, unsure, surface, count, near, fallen)
        level = level_with_ground(sides, steps.least, limits.drop)
        # Most of the columns around have risen and the ground goes on in others: what is as low
        # as ground may be is looked at by itself, or a box beside it would be level with it.
        if not set_apart(level, surface, height, steps.least, risen, part):
            break
    if level.any():
        add_level(level, surface, ground)
        field, height = _continued(cells, ground, measured, plane, size, up)
    patch = max(math.sqrt(4 * math.pi) * sensor.distortion_length / size.columns, 1.0)
    verdict = verdicts_of(sides, level, surface, patch)
    # What rises less than is never excused is no foot, however precise the sensor.
    rise = float(_CERTAIN * noise[0]), float((1 - _EXCUSED) * least)
    foot = feet_of(height, steep, cells.error, rise, steps.least, turned)
    lowest = limits.obstacle, limits.drop
    excused = _EXCUSED * least
    alike = (math.ceil(sensor.alike / size.rows), math.ceil(sensor.alike / size.columns))
    said = decide(verdict, surface, ground, fallen, foot, height, unsure, lowest, excused, alike)
    classes, heights = pixels_of(image, field, size, said)
    if known[0] == 0:
        stands, falls = ends_of(said.kind, height, steps.least, turned)
        # The rule of succession: nothing but the edge of a surface tells a table from a floor.
        ends = (stands + 1) / (stands + falls + 2)
        under = under._replace(confidence=under.confidence * ends)
    below = CellTerrain(cells.place, height, said.kind, unsure, turned)
    return Terrain(classes, heights, under, field, below)


def _continued(
    cells: Cells,
    ground: NDArray[np.bool_],
    measured: NDArray[np.float64],
    plane: NDArray[np.float64],
    size: CellSize,
    up: NDArray[np.float64],
) -> tuple[GroundField, NDArray[np.float32]]:
    """The ground everywhere, and the heights of cells above it."""
    theta = ground_field(sums_of(cells, ground), measured, plane)
    field = GroundField.of(theta, size, up)
    return field, cell_heights(cells, field, size)


def _without_ground(
    image: RangeImage,
    cells: Cells,
    size: CellSize,
    steep: NDArray[np.bool_],
    up: NDArray[np.float64],
    known: tuple[float, float],
    limits: Limits,
) -> Terrain:
    """No ground in sight: steep surfaces are obstacles, and what is above where it must be."""
    obstacle = steep.copy()
    height, doubt = known
    if height > 0:
        reach = np.hypot(cells.place[1], cells.place[2])
        bound = limits.obstacle + _CERTAIN * (doubt + limits.tilt * reach)
        obstacle |= cells.place[0] + height > bound
    wide = obstacle.repeat(size.rows, axis=0).repeat(size.columns, axis=1)
    wide = wide[: image.shape[0], : image.shape[1]]
    classes = np.where(image.valid & wide, OBSTACLE, UNKNOWN).astype(np.uint8)
    return Terrain(
        classes,
        np.full(image.shape, np.nan, np.float32),
        Stand(0, np.zeros(3), 0.0),
        GroundField.of(np.zeros((1, 1, 3)), size, up),
    )
