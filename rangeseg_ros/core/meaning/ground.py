"""Where a robot can drive: the ground it stands on, what stands on it, and where it ends.

In the order of the steps: cells, surfaces without a step, the surface under the robot, the ground
grown from there, the ground continued everywhere, and every pixel's height above that.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import Cells, CellSize, cells_of
from rangeseg_ros.core.meaning.classes import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.meaning.continuity import BROAD, Steps, join_cells, noise_of, surfaces_of
from rangeseg_ros.core.meaning.ground_field import (
    GroundField,
    cell_heights,
    ground_field,
)
from rangeseg_ros.core.meaning.growth import grown
from rangeseg_ros.core.meaning.pixels import Said, pixels_of
from rangeseg_ros.core.meaning.under_robot import FEWEST, TILT, Stand, solve_plane, stand
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

# Metres of the ground, from where it comes into view, that it is grown from.
_START = 0.25
# Cells that tell its plane.
_PLENTY = 300
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
    """

    slope: float
    obstacle: float
    drop: float


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
    if abs(up[0]) <= abs(up[1]):
        return _terrain(image, sensor, up, known, limits, bool(up[1] > 0))
    # A camera on its side: columns are along up in the image with rows and columns exchanged.
    rays = np.ascontiguousarray(image.rays.transpose(1, 0, 2))
    rays.flags.writeable = False  # as all rays are, or every kernel is compiled twice
    turned = RangeImage(rays, np.ascontiguousarray(image.inverse.T))
    found = _terrain(turned, sensor, up, known, limits, bool(up[0] > 0))
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
    slope = float(np.tan(limits.slope + TILT))
    steps = Steps.of(slope, least, noise, sensor.correlation / size.rows)
    surface, count, steep, broken = surfaces_of(cells, steps)
    under = stand(cells, surface, count, up, sensor, known, limits.slope)
    if under.surface == 0:
        return _without_ground(image, cells, size, steep, up, known, limits)
    flat = GroundField.of(under.theta[None, None], size, up)
    height = cell_heights(cells, flat, size)
    start = _nearest_part(height, cells.place, surface, under.surface, steps.least)
    ground = grown(height, cells, surface == under.surface, start, steps)
    # What remains is judged surface by surface, by its height beside the ground.
    field = GroundField.of(ground_field(cells, ground, under.theta), size, up)
    height = cell_heights(cells, field, size)
    surface, count = join_cells(cells, steps, steep | ground, broken)
    # The noise of a pixel: by the sensor model, and what the image shows if that is more.
    unsure = np.float32(_CERTAIN * max(noise[BROAD], 1.0)) * cells.error
    sizes, side, blur = _sides(height, unsure, surface, _around(ground), count)
    large = sizes >= FEWEST
    level = large & (np.abs(side) <= steps.least)
    if level.any():
        ground |= level[surface]
        field = GroundField.of(ground_field(cells, ground, under.theta), size, up)
        height = cell_heights(cells, field, size)
    # Little pieces among the ground are its noise.
    verdict = np.full(count + 1, GROUND, np.int8)
    verdict[0] = UNKNOWN
    verdict[large] = np.where(side[large] > 0, OBSTACLE, DROP)
    # A surface of far cells is as sure as each of them, as their errors are alike.
    verdict[large & (np.abs(side) <= blur)] = UNKNOWN
    verdict[level] = GROUND
    said = np.where(ground, np.int8(GROUND), verdict[surface])
    # What rises less than is never excused is no foot, however precise the sensor.
    rise = np.maximum(
        np.float32(_CERTAIN * noise[0]) * cells.error, np.float32((1 - _EXCUSED) * least)
    )
    said[_feet(height, steep, rise, steps.least, turned)] = OBSTACLE
    doubt = np.minimum(unsure, np.float32(_EXCUSED * least))
    bounds = limits.obstacle / 2, limits.drop / 2
    classes, heights = pixels_of(image, field, size, Said(said, doubt, unsure), bounds)
    if known[0] == 0:
        stands, falls = _edges(said, height, steps.least, turned)
        # The rule of succession: nothing but the edge of a surface tells a table from a floor.
        ends = (stands + 1) / (stands + falls + 2)
        under = under._replace(confidence=under.confidence * ends)
    below = CellTerrain(cells.place, height, said, unsure, turned)
    return Terrain(classes, heights, under, field, below)


@njit(cache=True, nogil=True)
def _nearest_part(
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    surface: NDArray[np.int32],
    chosen: int,
    tolerance: float,
) -> NDArray[np.bool_]:
    """Cells of a surface nearest to the robot that lie on one plane."""
    rows, columns = surface.shape
    nearest = np.inf
    for i in range(rows):
        for c in range(columns):
            if surface[i, c] == chosen:
                nearest = min(nearest, place[1, i, c] ** 2 + place[2, i, c] ** 2)
    reach = (np.sqrt(nearest) + _START) ** 2
    near = np.zeros((rows, columns), np.bool_)
    count = 0
    for i in range(rows):
        for c in range(columns):
            square = place[1, i, c] ** 2 + place[2, i, c] ** 2
            near[i, c] = surface[i, c] == chosen and square <= reach
            count += near[i, c]
    # Some of them tell the plane as well as all.
    step = max(count // _PLENTY, 1)
    points = np.empty((3, -(-count // step)))
    count = 0
    for i in range(rows):
        for c in range(columns):
            if near[i, c]:
                if count % step == 0:
                    k = count // step
                    points[0, k], points[1, k] = place[1, i, c], place[2, i, c]
                    points[2, k] = height[i, c]
                count += 1
    x, y, h = points[0], points[1], points[2]
    total = np.zeros(9)
    p, q, r = np.median(h), 0.0, 0.0
    for _ in range(3):
        off = np.abs(h - p - q * x - r * y)
        bound = max(tolerance, np.median(off))
        total[:] = 0
        for k in range(len(h)):
            if off[k] <= bound:
                entries = (1.0, x[k], y[k], x[k] * x[k], x[k] * y[k], y[k] * y[k], h[k])
                for n in range(7):
                    total[n] += entries[n]
                total[7] += h[k] * x[k]
                total[8] += h[k] * y[k]
        p, q, r = solve_plane(total, 1e-9, 1e-9)
    for i in range(rows):
        for c in range(columns):
            if near[i, c]:
                off_plane = height[i, c] - p - q * place[1, i, c] - r * place[2, i, c]
                near[i, c] = abs(off_plane) <= tolerance
    return near


def _around(where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Cells within three columns, or twelve rows, of one that is set."""
    around = cv2.dilate(where.view(np.uint8), np.ones((25, 7), np.uint8))
    return around.astype(np.uint8, copy=False)


@njit(cache=True, nogil=True)
def _sides(
    height: NDArray[np.float32],
    unsure: NDArray[np.float32],
    surface: NDArray[np.int32],
    near: NDArray[np.uint8],
    count: int,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Sizes of surfaces, how far they lie above the ground, and the noise of that, metres.

    Medians of the cells beside the ground, or of all; NaN for surfaces that are too small.
    """
    sizes = np.zeros(count + 1, np.int64)
    beside = np.zeros(count + 1, np.int64)
    for i in range(surface.shape[0]):
        for c in range(surface.shape[1]):
            sizes[surface[i, c]] += 1
            beside[surface[i, c]] += near[i, c]
    sizes[0] = 0
    # Cells in the order of their surfaces.
    start = np.zeros(count + 2, np.int64)
    for k in range(count + 1):
        start[k + 1] = start[k] + (sizes[k] if sizes[k] >= FEWEST else 0)
    heights = np.empty(start[-1], np.float32)
    noises = np.empty(start[-1], np.float32)
    filled = np.zeros(count + 1, np.int64)
    for i in range(surface.shape[0]):
        for c in range(surface.shape[1]):
            k = surface[i, c]
            if sizes[k] >= FEWEST and (near[i, c] or beside[k] < FEWEST):
                heights[start[k] + filled[k]] = height[i, c]
                noises[start[k] + filled[k]] = unsure[i, c]
                filled[k] += 1
    side = np.full(count + 1, np.nan)
    noise = np.full(count + 1, np.nan)
    for k in range(count + 1):
        if filled[k]:
            side[k] = np.median(heights[start[k] : start[k] + filled[k]])
            noise[k] = np.median(noises[start[k] : start[k] + filled[k]])
    return sizes, side, noise


@njit(cache=True, nogil=True)
def _edges(
    said: NDArray[np.int8], height: NDArray[np.float32], least: float, turned: bool
) -> tuple[int, int]:
    """Columns in which something stands where the ground ends, and in which it falls off."""
    rows, columns = height.shape
    stands = falls = 0
    for c in range(columns):
        beyond = 0
        for m in range(rows):  # towards the robot
            i = rows - 1 - m if turned else m
            if said[i, c] == GROUND and abs(height[i, c]) <= least:
                stands += beyond > 0
                falls += beyond < 0
                break
            if abs(height[i, c]) > least:
                beyond = 1 if height[i, c] > 0 else -1
    return stands, falls


@njit(cache=True, nogil=True)
def _feet(
    height: NDArray[np.float32],
    steep: NDArray[np.bool_],
    error: NDArray[np.float32],
    least: float,
    turned: bool,
) -> NDArray[np.bool_]:
    """Cells of a steep surface that rises to an obstacle above them in the image."""
    rows, columns = height.shape
    foot = np.zeros((rows, columns), np.bool_)
    above = np.zeros(columns, np.bool_)
    for m in range(rows):
        i = rows - 1 - m if turned else m
        for c in range(columns):
            if np.isnan(height[i, c]):
                continue
            if height[i, c] > least:
                above[c] = True
            elif above[c] and steep[i, c] and height[i, c] > error[i, c]:
                foot[i, c] = True
            else:
                above[c] = False
    return foot


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
        bound = limits.obstacle + _CERTAIN * (doubt + TILT * reach)
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
