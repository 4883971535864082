"""A floor plan from a map of planes: up, roles, walls with their openings, what is in the way."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.core.mapping.adjustment import Solution
from rangeseg_ros.core.mapping.map_planes import MapPlane, moved_planes
from rangeseg_ros.core.mapping.plane_grid import SURE, PlaneGrid
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import turn_between
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import HIT, MISS, chi2_quantile
from rangeseg_ros.core.tracking.plane_errors import moved_plane
from rangeseg_ros.plan.flights import Flight, flights
from rangeseg_ros.plan.right_angles import Squared, square_up

_ROUNDS = 5  # until the direction of up settles
FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of cells, as in nav_msgs/OccupancyGrid."""

# So many rows or columns of an image count, whichever are fewer.
_SAMPLES = 120


def points_within(image: RangeImage, sensor: SensorModel, error: float) -> Floats:
    """Some points (N, 3) of an image that err by less than `error` along the ray, metres."""
    step = max(min(image.shape) // _SAMPLES, 1)
    sample = np.s_[::step, ::step]
    inverse = image.inverse[sample].astype(np.float64)
    squared = np.where(inverse > 0, inverse, 1) ** 2
    variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
    sure = (inverse > 0) & (variance < (error * squared) ** 2)
    return image.points[sample][sure].astype(np.float64)


def occupancy(
    points: Iterable[Floats], ground: float, band: tuple[float, float], resolution: float
) -> PlaneGrid:
    """Log-odds that something stands in the way in cells of the ground.

    Points (N, 3) of each frame are with z up, as the heights of the ground and of the band above
    it in which things are in the way, metres. What is as far below the ground as the band begins
    above it is no ground.
    """
    grid = PlaneGrid(resolution, np.inf)
    for some in points:
        above = some[:, 2] - ground
        for chosen, change in (
            ((above >= band[0]) & (above < band[1]), HIT),
            (np.abs(above) < band[0], MISS),
        ):
            if chosen.any():
                grid.extend_to(some[chosen, :2])
                np.add.at(grid.odds, grid.cells(some[chosen, :2]), change)
    return grid


class PlanUp(NamedTuple):
    """The direction that is up in the fixed frame, and what tells it.

    Its standard deviation, radians, is 0 where it was told.
    """

    direction: Floats
    deviation: float
    source: str


class Wall(NamedTuple):
    """Where a plane of the plan stands upright: ends (N, 2, 2) of its parts, in order along it."""

    plane: int
    segments: Floats


class Opening(NamedTuple):
    """A gap, with its ends (2, 2), in the wall of a plane, through which the ground goes on."""

    plane: int
    ends: Floats

    @property
    def width(self) -> float:
        """Metres."""
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))


class FloorPlan(NamedTuple):
    """What a map of planes is as a plan, z up, metres.

    `motion` leads from the fixed frame, `frame`, to that of the plan: the identity where z of the
    former is up. `ground` is the height of the ground; planes have their roles in the plan.
    `cells` (H, W), of a side of `resolution`, are `FREE`, `OCCUPIED` or `UNKNOWN`, row 0 at the
    least y, and (x, y) of the outer corner of the first one are the `origin`.
    """

    frame: str
    motion: Transform
    up: PlanUp
    ground: float
    planes: list[Squared]
    walls: list[Wall]
    openings: list[Opening]
    stairs: list[Flight]
    cells: NDArray[np.int8]
    origin: tuple[float, float]
    resolution: float


def deviation_of(plane: MapPlane) -> float:
    """Standard deviation of a plane across itself at its centroid, metres."""
    lever = np.append(plane.centroid, 1)
    return float(np.sqrt(max(lever @ plane.covariance @ lever, 0)))


def estimate_up(planes: Sequence[MapPlane], looked: Floats, tolerance: float) -> PlanUp:
    """Which way is up by what is level and what is upright.

    Of the directions of planes near to what was up in the images, that with the largest area of
    planes at right angles to it or along it; refined by their least squares. `looked` (3,) is the
    mean of up in the images, in the fixed frame, `tolerance`, radians, the largest angle of level
    or upright planes to it.
    """
    looked = looked / np.linalg.norm(looked)
    normals = np.array([plane.normal for plane in planes]).reshape(-1, 3)
    area = np.array([plane.area for plane in planes])
    crossed = np.cross(normals[:, None], normals[None]).reshape(-1, 3)
    length = np.linalg.norm(crossed, axis=1)
    tried = np.concatenate([normals, crossed[length > 0.5] / length[length > 0.5, None]])
    tried = tried * np.where(tried @ looked < 0, -1, 1)[:, None]
    # A camera is turned less than half a right angle away from level in the mean.
    tried = tried[tried @ looked > np.sqrt(0.5)]
    if not len(tried):
        return PlanUp(looked, np.pi / 4, 'the images')
    cosine = np.abs(tried @ normals.T)
    fits = (cosine > np.cos(tolerance)) | (cosine < np.sin(tolerance))
    up = guess = tried[int((fits @ area * (tried @ looked)).argmax())]
    weight = np.array([1 / max(np.trace(p.covariance[:3, :3]), 1e-8) for p in planes])
    for _ in range(_ROUNDS):
        along = np.abs(normals @ up)
        level, upright = along > np.cos(tolerance), along < np.sin(tolerance)
        # w . n^2 is least for upright planes, |w x n|^2 for level ones.
        one = (normals.T * (weight * (1.0 * upright - level))) @ normals
        values, vectors = np.linalg.eigh(one + np.eye(3) * (weight @ level))
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    # One set of parallel walls leaves up free along them, and no level or upright plane anywhere.
    if values[1] < 1e-6 * values[2] or values[1] <= 0:
        return PlanUp(guess, np.pi / 4, 'planes that do not tell it')
    return PlanUp(up, float(1 / np.sqrt(values[1])), 'level and upright planes')


def make_plan(
    solution: Solution,
    frame: str,
    up: PlanUp,
    points: Iterable[Floats],
    stairs: Sequence[tuple[Stairs, Transform]],
    stood: Floats,
    config: Config,
    headroom: float,
    resolution: float,
) -> FloorPlan:
    """Turn the planes of a map, in a frame of that name, and points (N, 3) of frames into a plan.

    `stairs` are those that frames show, with the poses of these, `stood` (F, 3) where the ground
    was below the camera, NaN where nobody told. What is higher above the ground than the headroom,
    metres, is not in the way; `resolution`, metres, is the side of the cells of the grid. Of the
    parameters, `role_tolerance`, `role_area`, `role_height` and `obstacle_height` count.
    """
    tolerance = np.radians(config.role_tolerance)
    motion = _upright(up)
    turned = np.kron(np.eye(len(solution.planes)), moved_plane(*motion))
    covariance = turned @ solution.covariance @ turned.T
    squared = square_up(moved_planes(solution.planes, motion), covariance, tolerance)
    roles, ground = _roles(squared, motion.apply(stood)[:, 2], config)
    squared = [plane.named(role=role) for plane, role in zip(squared, roles, strict=True)]
    # Ground that errs by less than a cell is ground.
    band = (max(config.obstacle_height, resolution), headroom)
    grid = occupancy(map(motion.apply, points), ground, band, resolution)
    reach = ground + band[0], ground + headroom
    found = (
        _wall(k, plane, reach, resolution)
        for k, plane in enumerate(squared)
        if abs(plane.normal[2]) < np.sin(tolerance)
    )
    walls = [wall for wall in found if wall is not None]
    cells = _drawn(grid, [plane for plane in squared if plane.role == 'floor'], walls)
    openings = [o for wall in walls for o in _openings(wall, cells, grid)]
    x, y = (grid.first * resolution).tolist()
    seen = [(each, motion.after(pose)) for each, pose in stairs]
    parts = frame, motion, up, ground, squared, walls, openings, flights(seen)
    return FloorPlan(*parts, cells, (x, y), resolution)


def _upright(up: PlanUp) -> Transform:
    """The least turn that takes up to z; none where z is up within the errors."""
    cosine = float(np.clip(up.direction[2], -1, 1))
    if np.arccos(cosine) ** 2 <= chi2_quantile(2) * up.deviation**2:
        return Transform.identity()
    # Upside down, any level axis will do.
    turn = np.diag([1.0, -1, -1])
    if cosine > -1 + 1e-9:
        turn = turn_between(up.direction, np.eye(3)[2])
    return Transform(turn, np.zeros(3))


def _roles(planes: Sequence[MapPlane], stated: Floats, config: Config) -> tuple[list[str], float]:
    """Roles of planes in a frame whose z is up, and the height of the ground.

    The ground is the large plane that faces up and is nearest to the stated heights (F,), or the
    lowest; without one, the lowest point that was seen.
    """
    tolerance = np.radians(config.role_tolerance)
    tilt = np.array([plane.normal[2] for plane in planes])
    height = np.array([plane.centroid[2] for plane in planes])
    large = np.array([plane.area >= config.role_area for plane in planes], np.bool_)
    facing_up, facing_down = tilt > np.cos(tolerance), tilt < -np.cos(tolerance)
    lowest = [ring[:, 2].min() for plane in planes for ring in plane.outline.rings]
    level, stated = height[facing_up & large], stated[np.isfinite(stated)]
    ground = float(min(level.tolist() or lowest or [0.0]))
    off = np.abs(level - np.median(stated)) if len(stated) else np.full(len(level), np.inf)
    if off.min(initial=np.inf) <= config.role_height:
        ground = float(level[off.argmin()])
    top = height[facing_down & large].max(initial=-np.inf)
    found = np.full(len(planes), 'other', dtype='<U7')
    found[large & (np.abs(tilt) < np.sin(tolerance))] = 'wall'
    found[facing_down & (height > top - config.role_height)] = 'ceiling'
    found[facing_up & (np.abs(height - ground) < config.role_height)] = 'floor'
    found[facing_up & (height >= ground + config.role_height)] = 'table'
    return [str(role) for role in found], ground


def _wall(k: int, plane: MapPlane, reach: tuple[float, float], resolution: float) -> Wall | None:
    """Parts of an upright plane between two heights, as seen from above."""
    along = np.array([-plane.normal[1], plane.normal[0]])
    along /= np.linalg.norm(along)
    foot = plane.centroid[:2]
    # The plane as seen from the side: along the wall, and up.
    turned = np.stack([np.append(along, 0), [0, 0, 1]])
    parts = [[(r - np.append(foot, 0)) @ turned.T for r in part] for part in plane.outline.parts]
    polygons = [shapely.make_valid(shapely.Polygon(part[0], part[1:])) for part in parts]
    side = shapely.union_all(polygons)
    left, _, right, _ = side.bounds
    within = shapely.get_parts(shapely.clip_by_rect(side, left, reach[0], right, reach[1]))
    # What is seen of it as intervals along the wall; those that overlap are one.
    bounds = shapely.bounds(within[shapely.area(within) > 0]).reshape(-1, 4)
    if not len(bounds):
        return None
    starts, _, ends, _ = bounds[np.argsort(bounds[:, 0])].T
    ends = np.maximum.accumulate(ends)
    apart = starts[1:] > ends[:-1] + resolution / 2
    spans = np.stack([starts[np.append(True, apart)], ends[np.append(apart, True)]], axis=1)
    return Wall(k, foot + spans[..., None] * along)


def _openings(wall: Wall, cells: NDArray[np.int8], grid: PlaneGrid) -> list[Opening]:
    """Gaps of a wall in which the ground was seen on most of the way across."""
    found = []
    for ends in wall.segments.reshape(-1, 2)[1:-1].reshape(-1, 2, 2):
        width = float(np.linalg.norm(ends[1] - ends[0]))
        across = np.linspace(ends[0], ends[1], max(int(width / grid.side), 3))[1:-1]
        # Narrower than two cells, the grid does not tell.
        if width >= 2 * grid.side and (cells[grid.cells(across)] == FREE).mean() > 0.5:
            found.append(Opening(wall.plane, ends))
    return found


def _drawn(grid: PlaneGrid, floors: Sequence[MapPlane], walls: Sequence[Wall]) -> NDArray[np.int8]:
    """Cells in which points were seen, with the floors of the map and its walls."""
    free = [[ring[:, :2] for ring in part] for p in floors for part in p.outline.parts]
    lines = [ends for wall in walls for ends in wall.segments]
    for corners in [ring for part in free for ring in part] + lines:
        grid.extend_to(np.concatenate([corners - grid.side, corners + grid.side]))
    if not grid.odds.size:
        grid.extend_to(np.zeros((1, 2)))
    cells = np.where(grid.odds < 0, FREE, UNKNOWN).astype(np.int8)
    cells[grid.fill(free)] = FREE
    cells[grid.odds >= SURE] = OCCUPIED
    for start, end in lines:
        count = max(int(np.linalg.norm(end - start) / grid.side * 2), 1) + 1
        cells[grid.cells(np.linspace(start, end, count))] = OCCUPIED
    return cells
