"""A floor plan from a map of planes: up, roles, walls with their openings, what is in the way."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.adjustment import Solution
from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.core.mapping.occupancy import FREE, OCCUPIED, UNKNOWN, Grid, occupancy
from rangeseg_ros.core.mapping.placement import moved_planes
from rangeseg_ros.core.mapping.right_angles import Squared, square_up
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import rotation_by
from rangeseg_ros.core.significance import chi2_quantile
from rangeseg_ros.core.tracking.plane_errors import moved_plane

_ROUNDS = 5  # until the direction of up settles


class Up(NamedTuple):
    """The direction that is up in the fixed frame.

    Attributes
    ----------
    direction : (3,) float64
    deviation : float
        Standard deviation, radians; 0 where it was told.
    source : str
    """

    direction: NDArray[np.float64]
    deviation: float
    source: str


class Wall(NamedTuple):
    """Where a vertical plane stands on the plan.

    Attributes
    ----------
    plane : int
        Number of its plane in the plan.
    segments : (N, 2, 2) float64
        Ends of its parts, in their order along the wall, metres.
    low, high : float
        Heights between which it was seen.
    """

    plane: int
    segments: NDArray[np.float64]
    low: float
    high: float


class Opening(NamedTuple):
    """A gap in a wall through which the ground goes on.

    Attributes
    ----------
    plane : int
        Number of the wall's plane in the plan.
    ends : (2, 2) float64
        Metres.
    """

    plane: int
    ends: NDArray[np.float64]

    @property
    def width(self) -> float:
        """Metres."""
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """What a map of planes is as a plan, z up, metres.

    Attributes
    ----------
    frame : str
        Name of the fixed frame of the map.
    motion : Transform
        From the fixed frame to that of the plan; the identity where z of the former is up.
    up : Up
    ground : float
        Height of the ground.
    planes : list of Squared
        Of the map, in the frame of the plan, with their roles in it.
    walls : list of Wall
    openings : list of Opening
    grid : Grid
    """

    frame: str
    motion: Transform
    up: Up
    ground: float
    planes: list[Squared]
    walls: list[Wall]
    openings: list[Opening]
    grid: Grid


def deviation_of(plane: MapPlane) -> float:
    """Standard deviation of a plane across itself at its centroid, metres."""
    lever = np.append(plane.centroid, 1)
    return float(np.sqrt(max(lever @ plane.covariance @ lever, 0)))


def estimate_up(planes: Sequence[MapPlane], looked: NDArray[np.float64], tolerance: float) -> Up:
    """Which way is up by what is level and what is upright.

    Of the directions of planes near to what was up in the images, that with the largest area of
    planes at right angles to it or along it; refined by their least squares.

    Parameters
    ----------
    planes : sequence of MapPlane
    looked : (3,) float64
        Mean direction of up in the images, in the fixed frame.
    tolerance : float
        Largest angle of a level or upright plane to that, radians.
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
        return Up(looked, np.pi / 4, 'the images')
    cosine = np.abs(tried @ normals.T)
    fits = (cosine > np.cos(tolerance)) | (cosine < np.sin(tolerance))
    up = tried[int((fits @ area * (tried @ looked)).argmax())]
    information = np.zeros((3, 3))
    for _ in range(_ROUNDS):
        along = normals @ up
        level, upright = np.abs(along) > np.cos(tolerance), np.abs(along) < np.sin(tolerance)
        weight = np.array([1 / max(np.trace(p.covariance[:3, :3]), 1e-8) for p in planes])
        # w . n^2 is least for upright planes, |w x n|^2 for level ones.
        one = (normals.T * (weight * upright)) @ normals
        one += np.eye(3) * (weight @ level) - (normals.T * (weight * level)) @ normals
        values, vectors = np.linalg.eigh(one)
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
        information = one
    values = np.linalg.eigvalsh(information)
    # One set of parallel walls leaves up free along them.
    if values[1] < 1e-6 * values[2] or values[1] <= 0:
        return Up(up, np.pi / 4, 'planes that do not tell it')
    return Up(up, float(1 / np.sqrt(values[1])), 'level and upright planes')


def make_plan(
    solution: Solution,
    frame: str,
    up: Up,
    points: Iterable[NDArray[np.float64]],
    config: Config,
    headroom: float,
    resolution: float,
) -> FloorPlan:
    """Turn a map into a plan.

    Parameters
    ----------
    solution : Solution
        Its planes.
    frame : str
        Their frame.
    up : Up
    points : iterable of (N, 3) float64
        Of each frame, in that frame.
    config : Config
        `role_tolerance`, `role_area`, `role_height`, `obstacle_height`.
    headroom : float
        Height of what is to pass, metres: what is higher above the ground is not in the way.
    resolution : float
        Side of the cells of the grid, metres.
    """
    tolerance = np.radians(config.role_tolerance)
    motion = _upright(up)
    turned = np.kron(np.eye(len(solution.planes)), moved_plane(*motion))
    covariance = turned @ solution.covariance @ turned.T
    squared = square_up(moved_planes(solution.planes, motion), covariance, tolerance)
    roles, ground = _roles([s.plane for s in squared], config)
    squared = [
        s._replace(plane=s.plane.named(role=r)) for s, r in zip(squared, roles, strict=True)
    ]
    # Ground that errs by less than a cell is ground.
    band = (max(config.obstacle_height, resolution), headroom)
    upright = (some @ motion.rotation.T + motion.shift for some in points)
    grid = occupancy(upright, ground, band, resolution)
    reach = ground + band[0], ground + headroom
    walls = [
        wall
        for k, s in enumerate(squared)
        if abs(s.plane.normal[2]) < np.sin(tolerance)
        and (wall := _wall(k, s.plane, reach, resolution)) is not None
    ]
    grid = _drawn(grid, squared, walls)
    openings = [o for wall in walls for o in _openings(wall, grid)]
    return FloorPlan(frame, motion, up, ground, squared, walls, openings, grid)


def _upright(up: Up) -> Transform:
    """The least turn that takes up to z; none where z is up within the errors."""
    z = np.array([0.0, 0.0, 1.0])
    angle = np.arccos(np.clip(up.direction @ z, -1, 1))
    if angle**2 <= chi2_quantile(2) * up.deviation**2 or angle < 1e-9:
        return Transform.identity()
    axis = np.cross(up.direction, z)
    length = float(np.linalg.norm(axis))
    # Upside down, any level axis will do.
    turn = angle * (axis / length if length > 1e-9 else np.eye(3)[0])
    return Transform(rotation_by(turn), np.zeros(3))


def _roles(planes: Sequence[MapPlane], config: Config) -> tuple[list[str], float]:
    """Roles of planes in a frame whose z is up, and the height of the ground.

    The ground is the lowest large plane that faces up; without one, the lowest point that was
    seen.
    """
    tolerance = np.radians(config.role_tolerance)
    tilt = np.array([plane.normal[2] for plane in planes])
    height = np.array([plane.centroid[2] for plane in planes])
    large = np.array([plane.area >= config.role_area for plane in planes], np.bool_)
    facing_up, facing_down = tilt > np.cos(tolerance), tilt < -np.cos(tolerance)
    upright = np.abs(tilt) < np.sin(tolerance)
    corners = [ring[:, 2].min() for p in planes for part in p.outline.parts for ring in part]
    ground = min(corners, default=0.0)
    if (facing_up & large).any():
        ground = height[facing_up & large].min()
    top = height[facing_down & large].max(initial=-np.inf)
    floor = facing_up & (np.abs(height - ground) < config.role_height)
    ceiling = facing_down & (height > top - config.role_height)
    table = facing_up & (height >= ground + config.role_height)
    kinds = {'floor': floor, 'ceiling': ceiling, 'table': table, 'wall': upright & large}
    roles = ['other'] * len(planes)
    for name, chosen in kinds.items():
        for k in np.flatnonzero(chosen).tolist():
            roles[k] = name
    return roles, float(ground)


def _wall(k: int, plane: MapPlane, reach: tuple[float, float], resolution: float) -> Wall | None:
    """Parts of an upright plane between two heights, as seen from above."""
    along = np.array([-plane.normal[1], plane.normal[0]])
    along /= np.linalg.norm(along)
    foot = plane.centroid[:2]
    # The plane as seen from the side: along the wall, and up.
    turned = np.stack([np.append(along, 0), [0, 0, 1]])
    parts = [[(r - np.append(foot, 0)) @ turned.T for r in part] for part in plane.outline.parts]
    side = shapely.union_all(
        [shapely.make_valid(shapely.Polygon(part[0], part[1:])) for part in parts]
    )
    left, low, right, high = side.bounds
    within = shapely.get_parts(shapely.clip_by_rect(side, left, reach[0], right, reach[1]))
    # What is seen of it as intervals along the wall.
    starts, _, ends, _ = shapely.bounds(within[shapely.area(within) > 0]).reshape(-1, 4).T
    spans: list[list[float]] = []
    for start, end in sorted(zip(starts.tolist(), ends.tolist(), strict=True)):
        if spans and start <= spans[-1][1] + resolution / 2:
            spans[-1][1] = max(spans[-1][1], end)
        else:
            spans.append([start, end])
    if not spans:
        return None
    return Wall(k, foot + np.array(spans)[..., None] * along, float(low), float(high))


def _openings(wall: Wall, grid: Grid) -> list[Opening]:
    """Gaps of a wall in which the ground was seen on most of the way across."""
    found = []
    for before, after in zip(wall.segments[:-1], wall.segments[1:], strict=True):
        ends = np.stack([before[1], after[0]])
        width = float(np.linalg.norm(ends[1] - ends[0]))
        # Narrower than two cells, the grid does not tell.
        if width < 2 * grid.resolution:
            continue
        share = np.linspace(0, 1, max(int(width / grid.resolution), 3))[1:-1, None]
        if (grid.at(ends[0] + share * (ends[1] - ends[0])) == FREE).mean() > 0.5:
            found.append(Opening(wall.plane, ends))
    return found


def _drawn(grid: Grid, planes: Sequence[Squared], walls: Sequence[Wall]) -> Grid:
    """The grid with the floor of the map and its walls."""
    corners = [wall.segments.reshape(-1, 2) for wall in walls]
    floors = [s.plane for s in planes if s.plane.role == 'floor']
    corners += [ring[:, :2] for p in floors for part in p.outline.parts for ring in part]
    if not corners:
        return grid
    side, (height, width) = grid.resolution, grid.cells.shape
    reach = np.floor(np.concatenate(corners) / side).astype(np.intp)
    own = np.round(np.array(grid.origin) / side).astype(np.intp)
    first = np.minimum(reach.min(axis=0), own) - 1
    last = np.maximum(reach.max(axis=0) + 1, own + np.array([width, height])) + 1
    cells = np.full((last - first)[::-1], UNKNOWN, np.int8)
    y, x = np.indices(cells.shape)
    middles = (np.stack([x, y], axis=-1) + 0.5 + first) * side
    for plane in floors:
        for part in plane.outline.parts:
            area = shapely.make_valid(shapely.Polygon(part[0], part[1:]))
            cells[shapely.contains_xy(area, middles[..., 0], middles[..., 1])] = FREE
    place = own - first
    inside = cells[place[1] : place[1] + height, place[0] : place[0] + width]
    inside[grid.cells != UNKNOWN] = grid.cells[grid.cells != UNKNOWN]
    for wall in walls:
        for start, end in wall.segments:
            count = max(int(np.linalg.norm(end - start) / side * 2), 1) + 1
            at = start + np.linspace(0, 1, count)[:, None] * (end - start)
            column, row = (np.floor(at / side).astype(np.intp) - first).T
            cells[row, column] = OCCUPIED
    origin = float(first[0] * side), float(first[1] * side)
    return Grid(cells, origin, side)
