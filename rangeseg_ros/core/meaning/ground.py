"""Where a robot can drive: the ground it stands on, what stands on it, and where it ends."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.meaning.classes import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.meaning.continuity import (
    COLUMNS,
    Cells,
    cells_of,
    components,
    divided,
    noise_of,
    steps,
)
from rangeseg_ros.core.meaning.ground_field import BLOCK, ground_field
from rangeseg_ros.core.meaning.growth import grown
from rangeseg_ros.core.runtime.threads import strips
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance

# How well a robot knows its camera: standard deviations of height and tilt.
_HEIGHT, _TILT = 0.015, np.radians(1.5)
# Metres of a surface that tell where it lies under the robot.
_NEAR = 0.25
# Cells that can be a ground: less is the foot of something.
_FEWEST = 24


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
    base : (3,) float64
        Plane theta of the ground under the robot; zeros where none is known.
    field : (M, N, 3) float64
        The ground's plane for every block, see `ground_field`.
    """

    classes: NDArray[np.uint8]
    height: NDArray[np.float32]
    base: NDArray[np.float64]
    field: NDArray[np.float64]


def terrain_of(
    image: RangeImage, sensor: SensorModel, up: ArrayLike, sensor_height: float, limits: Limits
) -> Terrain:
    """Class and height of every pixel.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    sensor : SensorModel
    up : (3,) float
        Unit vector in the frame of the image.
    sensor_height : float
        Of the camera above the ground below it, metres; 0 = unknown.
    limits : Limits
    """
    upward = np.asarray(up, np.float64)
    if abs(upward[0]) > abs(upward[1]):  # a camera on its side: columns are along up here
        turned = RangeImage(
            np.ascontiguousarray(image.rays.transpose(1, 0, 2)),
            np.ascontiguousarray(image.inverse.T),
        )
        found = _terrain(turned, sensor, upward, sensor_height, limits, bool(upward[0] > 0))
        return found._replace(
            classes=np.ascontiguousarray(found.classes.T),
            height=np.ascontiguousarray(found.height.T),
            field=np.ascontiguousarray(found.field.transpose(1, 0, 2)),
        )
    return _terrain(image, sensor, upward, sensor_height, limits, bool(upward[1] > 0))


def _terrain(
    image: RangeImage,
    sensor: SensorModel,
    up: NDArray[np.float64],
    sensor_height: float,
    limits: Limits,
    turned: bool,
) -> Terrain:
    cells = cells_of(image.inverse, image.rays)
    deviation = np.sqrt(random_variance(sensor, cells.inverse.astype(np.float64) ** 2))
    place, error = _placed(cells, up, deviation)
    noise = noise_of(cells, deviation)
    # Half of the least step: what differs more is not the same ground.
    half = min(limits.obstacle, limits.drop) / 2
    slope = np.tan(limits.slope + _TILT)
    steep = divided(cells, _axes(up), error, np.sqrt(2) * float(noise[2]), slope)
    broken = np.zeros(error.shape, np.bool_)
    strips(steps, error.shape[1], place, error, noise, slope, half, steep, broken)
    steep = _closed(steep)
    surface, count = components(place, error, noise, slope, half, steep, broken)
    sizes = np.bincount(surface.ravel(), minlength=count + 1)
    sizes[0] = 0
    base, seed = _under_robot(cells, place, surface, sizes, up, sensor, sensor_height, limits)
    if seed == 0:
        return _without_ground(image, cells, place, steep, up, sensor_height, limits)
    doubt = np.minimum(3 * noise[-1] * error, 0.8 * min(limits.obstacle, limits.drop))
    tolerance = np.full(error.shape, half, np.float32)
    flat = _heights_above(base, cells, up)
    candidate = surface == seed
    start = _nearest_part(flat, place, candidate, half)
    grid = place, (noise[-1] * error) ** 2
    ground = grown(flat, *grid, candidate, start, slope, tolerance)
    # What remains is judged surface by surface.
    surface, count = components(place, error, noise, slope, half, steep | ground, broken)
    sizes = np.bincount(surface.ravel(), minlength=count + 1)
    sizes[0] = 0
    large = np.flatnonzero(sizes >= _FEWEST)
    side = np.zeros(count + 1)
    field = ground_field(cells, ground, base)
    height = heights(cells.inverse, cells.ray, field, up, COLUMNS)
    near = _grown(ground)
    for k in large:
        side[k] = _side(height, surface == k, near)
        if abs(side[k]) <= half:
            ground |= surface == k
    field = ground_field(cells, ground, base)
    height = heights(cells.inverse, cells.ray, field, up, COLUMNS)
    # Little pieces among the ground are its noise.
    verdict = np.full(count + 2, GROUND, np.int8)
    verdict[0] = UNKNOWN
    verdict[large] = np.where(side[large] > 0, OBSTACLE, DROP)
    surface[ground] = count + 1
    foot = _feet(height, steep, 3 * noise[0] * error, half, turned)
    classes = np.zeros(image.shape, np.uint8)
    pixel_height = np.full(image.shape, np.nan, np.float32)
    strips(
        _classify,
        image.shape[0],
        image.inverse,
        image.rays,
        field,
        up,
        surface,
        verdict,
        foot,
        (limits.obstacle / 2, limits.drop / 2),
        doubt,
        classes,
        pixel_height,
    )
    return Terrain(classes, pixel_height, base, field)


def _nearest_part(
    height: NDArray[np.float32],
    place: NDArray[np.float32],
    where: NDArray[np.bool_],
    tolerance: float,
) -> NDArray[np.bool_]:
    """Cells of a surface nearest to the robot that lie on one plane."""
    reach = np.hypot(place[..., 1], place[..., 2])
    part = where & (reach <= reach[where].min() + _NEAR)
    x, y, h = place[part, 1], place[part, 2], height[part]
    design = np.stack([np.ones(len(x)), x, y], axis=1).astype(np.float64)
    fits = np.ones(len(x), np.bool_)
    off = h - np.median(h)
    for _ in range(3):
        fits = np.abs(off) <= max(tolerance, float(np.median(np.abs(off))))
        off = h - design @ np.linalg.lstsq(design[fits], h[fits], rcond=None)[0]
    part[part] = np.abs(off) <= tolerance
    return part


def _closed(steep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Steps with their gaps closed, where noise hides them."""
    closed = cv2.morphologyEx(steep.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 7), np.uint8))
    return closed.astype(np.bool_)


def _heights_above(
    theta: NDArray[np.float64], cells: Cells, up: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Heights of cells above one plane, metres along up; NaN where nothing is measured."""
    with np.errstate(divide='ignore', invalid='ignore'):
        height = ((cells.ray @ theta.astype(np.float32)) / cells.inverse - 1) / (theta @ up)
    height[cells.inverse == 0] = np.nan
    return height.astype(np.float32)


def _placed(
    cells: Cells, up: NDArray[np.float64], deviation: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Height above the camera and horizontal position of cells, and the error of the height."""
    axes = _axes(up)
    with np.errstate(divide='ignore', invalid='ignore'):
        place = (cells.ray @ axes.T) / cells.inverse[..., None]
        error = np.abs(place[..., 0]) / cells.inverse * deviation
    place[cells.inverse == 0] = np.nan
    return place, error.astype(np.float32)


def _axes(up: NDArray[np.float64]) -> NDArray[np.float32]:
    """(3, 3) up and two horizontal directions, the first along the optical axis if it can be."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([0.0, -1.0, 0.0])
    flat = axis - (axis @ up) * up
    ahead = flat / np.linalg.norm(flat)
    return np.stack([up, ahead, np.cross(up, ahead)]).astype(np.float32)


def _under_robot(
    cells: Cells,
    place: NDArray[np.float32],
    surface: NDArray[np.int32],
    sizes: NDArray[np.intp],
    up: NDArray[np.float64],
    sensor: SensorModel,
    sensor_height: float,
    limits: Limits,
) -> tuple[NDArray[np.float64], int]:
    """Plane theta of the ground under the robot, and the surface it was found by; 0 for none.

    Of the surfaces the most probable one: by its size, and by how well its plane agrees with the
    stated height and tilt, or, on a ramp, with the height alone. The plane is the most probable
    one, of the surface and what is stated together.
    """
    best, base, seed = -np.inf, np.zeros(3), 0
    axes = _axes(up)[1:].astype(np.float64)
    patch = 4 * np.pi * max(sensor.distortion_length, 1) ** 2 / COLUMNS
    distance = np.hypot(place[..., 1], place[..., 2])
    nearest = distance[sizes[surface] >= _FEWEST].min(initial=np.inf)
    for k in np.argsort(-sizes, kind='stable')[:32]:
        if sizes[k] < _FEWEST:
            break
        where = surface == k
        height, x, y = place[where].T.astype(np.float64)
        inverse = cells.inverse[where].astype(np.float64)
        variance = systematic_variance(sensor, inverse**2) * patch
        variance += random_variance(sensor, inverse**2)
        weight = np.abs(inverse / height) / np.sqrt(variance)
        design = np.stack([np.ones(len(x)), x, y], axis=1) * weight[:, None]
        rise = (height + sensor_height) * weight
        reach = distance[where]
        farther = (reach.min() - nearest) / 0.25
        reach = reach - reach.min()
        for way, tilt, penalty in ((0.7, _TILT, 0.0), (0.7, limits.slope, 4.0), (0.2, _TILT, 4.0)):
            near = reach <= way
            spread = np.array([_HEIGHT if sensor_height > 0 else 1e3, tilt, tilt])
            matrix = design[near].T @ design[near] + np.diag(spread**-2.0)
            solved = np.linalg.solve(matrix, design[near].T @ rise[near])
            cost = ((rise[near] - design[near] @ solved) ** 2).sum() + (
                (solved / spread) ** 2
            ).sum()
            free = np.linalg.lstsq(design[near], rise[near], rcond=None)[0]
            misfit = float(cost - ((rise[near] - design[near] @ free) ** 2).sum())
            score = np.log(sizes[k]) - misfit / 2 - penalty - farther
            if sensor_height == 0:
                # Without a height, the surface that reaches nearest to the robot.
                score -= 4 * float(np.min(np.hypot(x, y) / np.maximum(-height, 1e-3)))
            below = sensor_height - solved[0]
            if misfit < 25 and below > 0.02 and score > best:
                normal = up - solved[1:] @ axes
                best, base, seed = score, -normal / below, int(k)
    return base, seed


def _side(height: NDArray[np.float32], where: NDArray[np.bool_], near: NDArray[np.bool_]) -> float:
    """How far a surface lies above the ground, metres: beside it, or anywhere."""
    beside = where & near
    return float(np.median(height[beside if beside.sum() >= 5 else where]))


def _grown(where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells within three cells, or 24 rows, of one that is set."""
    kernel = np.ones((49, 7), np.uint8)
    return cv2.dilate(where.astype(np.uint8), kernel).astype(bool)


def _feet(
    height: NDArray[np.float32],
    steep: NDArray[np.bool_],
    error: NDArray[np.float32],
    least: float,
    turned: bool,
) -> NDArray[np.bool_]:
    """Cells of a steep surface that rises to an obstacle above them in the image."""
    foot = np.zeros(height.shape, np.bool_)
    order = slice(None, None, -1 if turned else 1)
    _hang(height[order], steep[order], error[order], least, foot[order])
    return foot


@njit(cache=True)
def _hang(
    height: NDArray[np.float32],
    steep: NDArray[np.bool_],
    error: NDArray[np.float32],
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


def heights(
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    field: NDArray[np.float64],
    up: NDArray[np.float64],
    columns: int = 1,
) -> NDArray[np.float32]:
    """Height above the ground, metres along up; NaN where nothing is measured.

    Parameters
    ----------
    inverse, rays : (R, C), (R, C, 3) float32
        Of pixels, or of cells of so many columns.
    field : (M, N, 3) float64
    up : (3,) float64
    columns : int
    """
    result = np.full(inverse.shape, np.nan, np.float32)
    strips(_heights, len(inverse), inverse, rays, field, up, columns, result)
    return result


@njit(cache=True, nogil=True)
def _heights(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    field: NDArray[np.float64],
    up: NDArray[np.float64],
    columns: int,
    result: NDArray[np.float32],
) -> None:
    for i in range(first, after):
        for j in range(inverse.shape[1]):
            if inverse[i, j] > 0:
                theta = interpolated(field, i, (j + 0.5) * columns - 0.5)
                result[i, j] = _height(theta, inverse[i, j], rays[i, j], up)


@njit(cache=True, inline='always')
def interpolated(
    field: NDArray[np.float64], row: float, column: float
) -> tuple[float, float, float]:
    """Plane of the ground at a pixel, between those of the blocks around it."""
    y = min(max((row + 0.5) / BLOCK - 0.5, 0.0), field.shape[0] - 1.0)
    x = min(max((column + 0.5) / BLOCK - 0.5, 0.0), field.shape[1] - 1.0)
    i, j = int(y), int(x)
    k, m = min(i + 1, field.shape[0] - 1), min(j + 1, field.shape[1] - 1)
    v, u = y - i, x - j
    a, b, c, d = (1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u
    return (
        a * field[i, j, 0] + b * field[i, m, 0] + c * field[k, j, 0] + d * field[k, m, 0],
        a * field[i, j, 1] + b * field[i, m, 1] + c * field[k, j, 1] + d * field[k, m, 1],
        a * field[i, j, 2] + b * field[i, m, 2] + c * field[k, j, 2] + d * field[k, m, 2],
    )


@njit(cache=True, inline='always')
def _height(
    theta: tuple[float, float, float],
    inverse: float,
    ray: NDArray[np.float32],
    up: NDArray[np.float64],
) -> float:
    """Of the point above the plane theta . p = 1, along up."""
    along = theta[0] * ray[0] + theta[1] * ray[1] + theta[2] * ray[2]
    rise = theta[0] * up[0] + theta[1] * up[1] + theta[2] * up[2]
    return (along / inverse - 1) / rise


@njit(cache=True, nogil=True)
def _classify(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    field: NDArray[np.float64],
    up: NDArray[np.float64],
    surface: NDArray[np.int32],
    verdict: NDArray[np.int8],
    foot: NDArray[np.bool_],
    least: tuple[float, float],
    doubt: NDArray[np.float32],
    classes: NDArray[np.uint8],
    heights: NDArray[np.float32],
) -> None:
    for i in range(first, after):
        for j in range(inverse.shape[1]):
            if inverse[i, j] == 0:
                continue
            theta = interpolated(field, i, j)
            height = _height(theta, inverse[i, j], rays[i, j], up)
            heights[i, j] = height
            c = j // COLUMNS
            said = verdict[surface[i, c]]
            if said > GROUND:
                classes[i, j] = said
            elif said == GROUND and abs(height) < doubt[i, c]:
                classes[i, j] = GROUND
            elif height > least[0]:
                classes[i, j] = OBSTACLE
            elif height < -least[1]:
                classes[i, j] = DROP
            elif foot[i, c]:
                classes[i, j] = OBSTACLE
            else:
                classes[i, j] = GROUND


def _without_ground(
    image: RangeImage,
    cells: Cells,
    place: NDArray[np.float32],
    steep: NDArray[np.bool_],
    up: NDArray[np.float64],
    sensor_height: float,
    limits: Limits,
) -> Terrain:
    """No ground in sight: steep surfaces are obstacles, and what is above where it must be."""
    obstacle = steep.copy()
    if sensor_height > 0:
        reach = np.hypot(place[..., 1], place[..., 2])
        doubt = limits.obstacle + 3 * _HEIGHT + np.tan(3 * _TILT) * reach
        obstacle |= place[..., 0] + sensor_height > doubt
    wide = np.repeat(obstacle, COLUMNS, axis=1)[:, : image.shape[1]]
    classes = np.where(image.valid & wide, OBSTACLE, UNKNOWN).astype(np.uint8)
    blocks = -(-image.shape[0] // BLOCK), -(-image.shape[1] // BLOCK)
    height = np.full(image.shape, np.nan, np.float32)
    return Terrain(classes, height, np.zeros(3), np.zeros((*blocks, 3)))
