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
from rangeseg_ros.core.meaning.continuity import Steps, join_cells, noise_of, surfaces_of
from rangeseg_ros.core.meaning.ground_field import (
    GroundField,
    cell_heights,
    ground_field,
)
from rangeseg_ros.core.meaning.growth import grown
from rangeseg_ros.core.meaning.pixels import Said, pixels_of
from rangeseg_ros.core.meaning.under_robot import FEWEST, TILT, Stand, stand
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

# Metres of the ground, from where it comes into view, that it is grown from.
_START = 0.25
# Cells that tell its plane.
_PLENTY = 1000
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
    remembered : float
        How far below the camera the ground was, metres, when it is out of view; 0 for unknown.
    """

    classes: NDArray[np.uint8]
    height: NDArray[np.float32]
    stand: Stand
    field: GroundField
    remembered: float = 0.0

    def __str__(self) -> str:
        """Where the ground is and how sure that is, in a few words."""
        if not self.stand.surface:
            where = f': it was {self.remembered:.2f} m below' if self.remembered else ''
            return f'no ground in view{where}'
        height = self.stand.height(self.field.up)
        return f'ground {height:.2f} m below, confidence {self.stand.confidence:.2f}'


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
    # Half of the least step: what differs more is not the same ground.
    steps = Steps(float(np.tan(limits.slope + TILT)), least / 2, noise)
    surface, _, steep, broken = surfaces_of(cells, steps)
    under = stand(cells, surface, up, sensor, known, limits.slope)
    if under.surface == 0:
        return _without_ground(image, cells, size, steep, up, known, limits)
    flat = GroundField.of(under.theta[None, None], size, up)
    candidate = surface == under.surface
    height = cell_heights(cells, flat, size)
    start = _nearest_part(height, cells.place, candidate, steps.least)
    ground = grown(height, cells, candidate, start, steps)
    # What remains is judged surface by surface, by its height beside the ground.
    field = GroundField.of(ground_field(cells, ground, under.theta), size, up)
    height = cell_heights(cells, field, size)
    surface, count = join_cells(cells, steps, steep | ground, broken)
    large = np.flatnonzero(np.bincount(surface.ravel(), minlength=count + 1) >= FEWEST)
    large = large[large > 0]
    side = _sides(height, surface, _around(ground), large)
    level = large[np.abs(side) <= steps.least]
    ground |= np.isin(surface, level)
    field = GroundField.of(ground_field(cells, ground, under.theta), size, up)
    # Little pieces among the ground are its noise.
    verdict = np.full(count + 1, GROUND, np.int8)
    verdict[0] = UNKNOWN
    unsure = (_CERTAIN * noise[-1] * cells.error).astype(np.float32)
    verdict[large] = np.where(side > 0, OBSTACLE, DROP)
    for k in large[side < -steps.least]:
        # A surface of far cells is as sure as each of them, as their errors are alike.
        if -side[large == k][0] <= np.median(unsure[surface == k]):
            verdict[k] = UNKNOWN
    verdict[level] = GROUND
    said = np.where(ground, GROUND, verdict[surface]).astype(np.int8)
    # What rises less than is never excused is no foot, however precise the sensor.
    rise = np.maximum(_CERTAIN * noise[0] * cells.error, (1 - _EXCUSED) * least)
    foot = _feet(cell_heights(cells, field, size), steep, rise, steps.least, turned)
    said[foot] = OBSTACLE
    doubt = np.minimum(unsure, np.float32(_EXCUSED * least))
    bounds = limits.obstacle / 2, limits.drop / 2
    classes, heights = pixels_of(image, field, size, Said(said, doubt, unsure), bounds)
    return Terrain(classes, heights, under, field)


def _nearest_part(
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    where: NDArray[np.bool_],
    tolerance: float,
) -> NDArray[np.bool_]:
    """Cells of a surface nearest to the robot that lie on one plane."""
    with np.errstate(invalid='ignore'):
        square = np.where(where, place[..., 1] ** 2 + place[..., 2] ** 2, np.inf)
    near = square <= (np.sqrt(square.min()) + _START) ** 2
    rows, columns = np.nonzero(near)
    x, y = place[rows, columns, 1:].T.astype(np.float64)
    h = height[rows, columns].astype(np.float64)
    design = np.stack([np.ones(len(x)), x, y], axis=1)
    # Some of them tell the plane as well as all.
    some = slice(None, None, max(len(x) // _PLENTY, 1))
    plane = np.array([np.median(h[some]), 0.0, 0.0])
    for _ in range(3):
        off = np.abs(h[some] - design[some] @ plane)
        fits = design[some][off <= max(tolerance, float(np.median(off)))]
        heights = h[some][off <= max(tolerance, float(np.median(off)))]
        plane = np.linalg.solve(fits.T @ fits + 1e-9 * np.eye(3), fits.T @ heights)
    inside = np.abs(h - design @ plane) <= tolerance
    part = np.zeros(where.shape, np.bool_)
    part[rows[inside], columns[inside]] = True
    return part


def _around(where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells within three columns, or 24 rows, of one that is set."""
    grown_cells = cv2.dilate(where.view(np.uint8), np.ones((49, 7), np.uint8))
    return grown_cells.view(np.bool_)


def _sides(
    height: NDArray[np.float32],
    surface: NDArray[np.int32],
    near: NDArray[np.bool_],
    chosen: NDArray[np.intp],
) -> NDArray[np.float64]:
    """How far surfaces lie above the ground, metres: beside it, or anywhere."""
    found = []
    for k in chosen:
        where = surface == k
        beside = where & near
        found.append(float(np.median(height[beside if beside.sum() >= 5 else where])))
    return np.array(found)


def _feet(
    height: NDArray[np.float32],
    steep: NDArray[np.bool_],
    error: NDArray[np.float64],
    least: float,
    turned: bool,
) -> NDArray[np.bool_]:
    """Cells of a steep surface that rises to an obstacle above them in the image."""
    foot = np.zeros(height.shape, np.bool_)
    order = slice(None, None, -1 if turned else 1)
    _hang(height[order], steep[order], error[order], least, foot[order])
    return foot


@njit(cache=True, nogil=True)
def _hang(
    height: NDArray[np.float32],
    steep: NDArray[np.bool_],
    error: NDArray[np.float64],
    least: float,
    foot: NDArray[np.bool_],
) -> None:
    for c in range(height.shape[1]):
        above = False
        for i in range(height.shape[0]):
            if np.isnan(height[i, c]):
                continue
            if height[i, c] > least:
                above = True
            elif above and steep[i, c] and height[i, c] > error[i, c]:
                foot[i, c] = True
            else:
                above = False


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
        reach = np.hypot(cells.place[..., 1], cells.place[..., 2])
        bound = limits.obstacle + _CERTAIN * (doubt + TILT * reach)
        obstacle |= cells.place[..., 0] + height > bound
    wide = obstacle.repeat(size.rows, axis=0).repeat(size.columns, axis=1)
    wide = wide[: image.shape[0], : image.shape[1]]
    classes = np.where(image.valid & wide, OBSTACLE, UNKNOWN).astype(np.uint8)
    return Terrain(
        classes,
        np.full(image.shape, np.nan, np.float32),
        Stand(0, np.zeros(3), 0.0),
        GroundField.of(np.zeros((1, 1, 3)), size, up),
    )
