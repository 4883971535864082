"""Ground with all that stops a robot, as a depth camera on the robot sees it, and the truth.

World frame: x ahead, y to the left, z up, metres; the robot stands at the origin on z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.meaning.classes import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.sensors.sensor import Sensor
from rangeseg_ros.simulation.solids import Solid, box, cast, cylinder, prism

LEAST = 0.05
"""Height from which on something is an obstacle, and depth from which on a drop, metres."""
_FAR = 12.0
_WIDE = 8.0


class Wave(NamedTuple):
    """Undulation of the ground: amplitude (m), wave numbers along x and y (1/m), phase."""

    amplitude: float
    along: float
    across: float
    phase: float

    def height(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(...) height at points (..., 3)."""
        angle = self.along * points[..., 0] + self.across * points[..., 1] + self.phase
        return self.amplitude * np.sin(angle)


@dataclass(frozen=True, eq=False)
class Piece:
    """A solid and what it is to a robot.

    Attributes
    ----------
    solid : Solid
    terrain : int
        Its class.
    size : float
        How far the whole object stands above the ground, or how deep the drop is, metres.
    seen : {'surface', 'mirror', 'nothing'}
        Whether the surface is measured, the mirror image behind it, or nothing.
    """

    solid: Solid
    terrain: int
    size: float = 0.0
    seen: str = 'surface'


@dataclass(frozen=True, eq=False)
class Terrain:
    """A scene: what there is, the ground as if nothing interrupted it, and the camera.

    Attributes
    ----------
    kind : str
        Of `KINDS`.
    pieces : tuple of Piece
    ground : tuple of Solid
        The ground continued, without holes and edges.
    pose : Pose
    waves : tuple of Wave
        Added to the ground.
    stairs : dict
        `direction`, `count`, `rise`, `run` of a staircase; empty without one.
    """

    kind: str
    pieces: tuple[Piece, ...]
    ground: tuple[Solid, ...]
    pose: Pose
    waves: tuple[Wave, ...] = ()
    stairs: dict[str, float | str] = field(default_factory=dict)

    @property
    def up(self) -> NDArray[np.float64]:
        """Up in the optical frame."""
        return self.pose.rotation[2]


class TerrainFrame(NamedTuple):
    """A simulated depth image and its truth.

    Attributes
    ----------
    depth : (H, W) uint16 or float32
        As the sensor delivers it.
    terrain : (H, W) uint8
        True class; 0 where nothing is measured or the class is not judged (lower than
        obstacles, less deep than drops).
    height : (H, W) float32
        True height above the ground below the point, metres; NaN where nothing is measured.
    size : (H, W) float32
        Height of the whole object, or depth of the drop, metres; 0 for ground.
    crossing : (H, W) float32
        Depth at which the ray crosses the ground continued, metres; inf where it does not.
    """

    depth: NDArray[np.uint16] | NDArray[np.float32]
    terrain: NDArray[np.uint8]
    height: NDArray[np.float32]
    size: NDArray[np.float32]
    crossing: NDArray[np.float32]


def simulate_terrain(
    scene: Terrain, sensor: Sensor, camera: Camera | None = None, seed: int = 0
) -> TerrainFrame:
    """Depth image of a terrain with its truth.

    Parameters
    ----------
    scene : Terrain
    sensor : Sensor
        How it is measured.
    camera : Camera, optional
        The sensor's own when not given.
    seed : int
        Of the frame's noise.
    """
    camera = camera or sensor.camera
    origin = scene.pose.position
    rays = camera.rays.astype(np.float64) @ scene.pose.rotation.T
    depth, piece = _first_hit([p.solid for p in scene.pieces], origin, rays)
    mirror = _of(scene, piece, lambda p: p.seen == 'mirror', False)
    if mirror.any():
        images = [p for p in scene.pieces if p.terrain == OBSTACLE]
        behind, _ = cast([_mirrored(p.solid) for p in images], origin, rays[mirror])
        depth[mirror] = behind
    terrain = _of(scene, piece, lambda p: p.terrain, UNKNOWN).astype(np.uint8)
    size = _of(scene, piece, lambda p: p.size, 0.0)
    on_ground = terrain == GROUND
    depth[on_ground] = _on_waves(scene.waves, origin, rays[on_ground], depth[on_ground])
    points = origin + np.where(np.isfinite(depth), depth, 1)[..., None] * rays
    height = points[..., 2] - _ground_below(scene, points)
    lifted = sum((wave.height(points) for wave in scene.waves), np.zeros(depth.shape))
    size = np.where(mirror, -height, size - lifted)

    hidden = _of(scene, piece, lambda p: p.seen == 'nothing', False)
    measured = sensor.measure(
        np.where(hidden, np.inf, depth), camera, np.random.default_rng([seed, 12])
    )
    terrain[(measured == 0) | ((terrain != GROUND) & (size < LEAST))] = UNKNOWN
    terrain[(terrain == DROP) & (height > -LEAST)] = UNKNOWN
    crossing, _ = cast(scene.ground, origin, rays)
    return TerrainFrame(
        measured,
        terrain,
        np.where(measured > 0, height, np.nan).astype(np.float32),
        size.astype(np.float32),
        crossing.astype(np.float32),
    )


def _first_hit(
    solids: list[Solid], origin: NDArray[np.float64], rays: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Depth of the first hit of every ray, and which solid it is; inf and -1 for none."""
    depth, face = cast(solids, origin, rays)
    last = np.cumsum([solid.face_count for solid in solids])
    return depth, np.where(face < 0, -1, np.searchsorted(last, face, side='right'))


def _of(
    scene: Terrain, piece: NDArray[np.intp], value: Callable[[Piece], object], none: object
) -> NDArray:
    """What is said of the pieces that the pixels see."""
    return np.array([*map(value, scene.pieces), none])[piece]


def _mirrored(solid: Solid) -> Solid:
    """The image of a solid in the plane z = 0."""
    flip = np.array([1.0, 1.0, -1.0])
    quadric = solid.quadric
    if quadric is not None:
        turn = np.append(flip, 1.0)
        quadric = quadric * np.outer(turn, turn)
    return Solid(solid.normals * flip, solid.offsets, quadric)


def _on_waves(
    waves: tuple[Wave, ...],
    origin: NDArray[np.float64],
    rays: NDArray[np.float64],
    depth: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Depth of rays that meet the ground at `depth` without the waves."""
    flat = (origin + depth[:, None] * rays)[:, 2]
    for _ in range(8 if waves else 0):
        points = origin + depth[:, None] * rays
        above = points[:, 2] - flat - sum(wave.height(points) for wave in waves)
        depth = depth - above / rays[:, 2]
    return depth


def _ground_below(scene: Terrain, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the ground continued at the places of points (H, W, 3)."""
    above = points.copy()
    above[..., 2] = 20.0
    depth, _ = cast(scene.ground, above, np.broadcast_to([0.0, 0.0, -1.0], points.shape))
    level = np.where(np.isfinite(depth), 20.0 - depth, 0)
    return level + sum((wave.height(points) for wave in scene.waves), np.zeros(depth.shape))


def slab(start: float, end: float, low: float, high: float, y: tuple[float, float]) -> Solid:
    """Ground from x = start to end, rising from z = low to high, 3 m deep, between two y."""
    bottom = min(low, high) - 3.0
    outline = np.array([(start, bottom), (end, bottom), (end, high), (start, low)])
    # The prism's own x, y, z are the world's x, z, -y.
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return prism(outline, y[1] - y[0], rotation, (0, (y[0] + y[1]) / 2, 0))


ALL = (-_WIDE, _WIDE)


class _Site:
    """A terrain under construction: the robot looks along x."""

    def __init__(self, kind: str, seed: int) -> None:
        self.kind = kind
        self.random = random = np.random.default_rng([seed, 11])
        self.height = random.uniform(0.3, 1.6)
        aim = random.uniform(0.9, 3.5)
        self.pitch = float(np.clip(np.degrees(np.arctan2(self.height, aim)), 0, 60))
        self.pitch = float(np.clip(self.pitch + random.uniform(-8, 4), 0, 60))
        self.roll = random.uniform(-10, 10) if random.random() < 0.5 else random.uniform(-2, 2)
        # Where the ground comes into view: the image reaches 21 degrees below its middle.
        below = np.radians(min(self.pitch + 20, 85))
        self.near = max(self.height / np.tan(below), float(np.sqrt(max(0.75 - self.height, 0))))
        self.pieces: list[Piece] = []
        self.ground: list[Solid] = []
        self.waves: tuple[Wave, ...] = ()
        self.stairs: dict[str, float | str] = {}

    def ahead(self, least: float = 0.25, most: float = 1.4) -> float:
        """Somewhere beyond where the ground comes into view."""
        return self.near + self.random.uniform(least, most)

    def floor(self, start: float = -3, end: float = _FAR, low: float = 0, high: float = 0) -> None:
        """Ground that is there."""
        solid = slab(start, end, low, high, ALL)
        self.pieces.append(Piece(solid, GROUND))
        self.ground.append(solid)

    def continued(self, start: float, end: float = _FAR) -> None:
        """Ground that is not there."""
        self.ground.append(slab(start, end, 0, 0, ALL))

    def piece(self, solid: Solid, terrain: int, size: float, seen: str = 'surface') -> None:
        self.pieces.append(Piece(solid, terrain, size, seen))

    def walls(self) -> None:
        """Walls around, and a ceiling."""
        far, side = self.random.uniform(4, 7), self.random.uniform(1.5, 3)
        for centre, size in (
            ((far + 0.5, 0, 0), (1, 20, 12)),
            ((0, side + 0.5, 0), (20, 1, 12)),
            ((0, -side - 0.7, 0), (20, 1, 12)),
            ((0, 0, self.random.uniform(2.3, 3) + 0.5), (20, 20, 1)),
        ):
            self.piece(box(size, np.eye(3), centre), OBSTACLE, 3.0)

    def boxes(self, count: int) -> None:
        """Boxes from 3 cm on the ground."""
        for _ in range(count):
            height = float(self.random.choice([0.03, 0.05, 0.06, 0.08, 0.1, 0.15, 0.25, 0.5]))
            length, width = self.random.uniform(0.12, 0.6, 2)
            place = self.near + self.random.uniform(0.2, 2.2), self.random.uniform(-0.8, 0.8)
            self.piece(
                box((length, width, height), _turned(self.random), (*place, height / 2)),
                OBSTACLE,
                height,
            )

    def poles(self, count: int) -> None:
        """Legs and posts of 2 to 6 cm."""
        for _ in range(count):
            place = self.near + self.random.uniform(0.2, 2.0), self.random.uniform(-0.8, 0.8)
            height = self.random.uniform(0.3, 1.5)
            pole = cylinder(
                self.random.uniform(0.01, 0.03), height, np.eye(3), (*place, height / 2)
            )
            self.piece(pole, OBSTACLE, height)

    def cable(self) -> None:
        """A cable or bar of 1 to 3 cm that hangs across."""
        height, radius = self.random.uniform(0.08, 0.6), self.random.uniform(0.005, 0.015)
        lying = Rotation.from_euler('x', 90, degrees=True).as_matrix()
        turn = Rotation.from_euler('z', self.random.uniform(-30, 30), degrees=True).as_matrix()
        self.piece(
            cylinder(radius, 3, turn @ lying, (self.ahead(), 0, height)), OBSTACLE, height + radius
        )

    def table(self, ahead: float) -> None:
        """A table on four legs."""
        length, width = self.random.uniform(0.5, 0.9), self.random.uniform(0.7, 1.4)
        top, y = self.random.uniform(0.4, 0.75), self.random.uniform(-0.5, 0.5)
        centre = ahead + length / 2
        self.piece(box((length, width, 0.03), np.eye(3), (centre, y, top - 0.015)), OBSTACLE, top)
        for i in (-1, 1):
            for j in (-1, 1):
                foot = centre + i * (length / 2 - 0.05), y + j * (width / 2 - 0.05), top / 2
                self.piece(box((0.05, 0.05, top), np.eye(3), foot), OBSTACLE, top)

    def terrain(self) -> Terrain:
        """The finished scene."""
        pose = Pose.looking(
            (0, 0, self.height), self.random.uniform(-12, 12), self.pitch, self.roll
        )
        return Terrain(
            self.kind, tuple(self.pieces), tuple(self.ground), pose, self.waves, self.stairs
        )


def _turned(random: np.random.Generator) -> NDArray[np.float64]:
    rotation: NDArray[np.float64] = Rotation.from_euler(
        'z', random.uniform(0, 90), degrees=True
    ).as_matrix()
    return rotation


def _room(site: _Site) -> None:
    site.floor()
    site.walls()
    site.boxes(int(site.random.integers(1, 4)))


def _low(site: _Site) -> None:
    site.floor()
    site.boxes(int(site.random.integers(3, 7)))


def _clutter(site: _Site) -> None:
    site.floor()
    site.walls()
    site.table(site.ahead(0.4, 1.5))
    site.poles(int(site.random.integers(1, 4)))
    site.cable()


def _wavy(site: _Site) -> None:
    site.floor()
    site.boxes(2)
    length = site.random.uniform(1.5, 3, 2)
    site.waves = tuple(
        Wave(site.random.uniform(0.005, 0.015), 2 * np.pi / m, site.random.uniform(-1, 1), p)
        for m, p in zip(length, site.random.uniform(0, 6, 2), strict=True)
    )


def _drop(site: _Site) -> None:
    edge = site.ahead()
    depth = float(site.random.choice([0.05, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0]))
    site.floor(end=edge)
    site.continued(edge)
    site.piece(slab(edge, _FAR, -depth, -depth, ALL), DROP, depth)


def _hole(site: _Site) -> None:
    start = site.ahead(0.2, 1.0)
    end, side = start + site.random.uniform(0.3, 0.9), site.random.uniform(0.2, 0.8)
    middle = site.random.uniform(-0.3, 0.3)
    depth = float(site.random.choice([0.06, 0.1, 0.2, 0.4]))
    near, far = (start, end), (middle - side, middle + side)
    site.floor(end=near[0])
    site.floor(start=near[1])
    site.continued(*near)
    for y in ((-_WIDE, far[0]), (far[1], _WIDE)):
        site.piece(slab(*near, 0, 0, y), GROUND, 0)
    bottom = slab(*near, -depth, -depth, far)
    dark = site.kind == 'pit'
    site.piece(bottom, DROP, depth, 'nothing' if dark else 'surface')
    # The sides of the hole belong to it.
    for solid in (
        slab(near[1] - 0.01, near[1], -0.002, -0.002, far),
        slab(*near, -0.002, -0.002, (far[0], far[0] + 0.01)),
        slab(*near, -0.002, -0.002, (far[1] - 0.01, far[1])),
    ):
        site.piece(solid, DROP, depth, 'nothing' if dark else 'surface')


def _stairs_down(site: _Site) -> None:
    edge, count = site.ahead(0.2, 1.2), int(site.random.integers(3, 9))
    rise, run = site.random.uniform(0.12, 0.2), site.random.uniform(0.24, 0.34)
    site.floor(end=edge)
    site.continued(edge)
    for k in range(count):
        end = edge + (k + 1) * run if k < count - 1 else _FAR
        level = -(k + 1) * rise
        site.piece(slab(edge + k * run, end, level, level, ALL), DROP, -level)
    site.stairs = {'direction': 'down', 'count': count, 'rise': rise, 'run': run}


def _stairs_up(site: _Site) -> None:
    edge, count = site.ahead(0.4, 1.8), int(site.random.integers(3, 9))
    rise, run = site.random.uniform(0.12, 0.2), site.random.uniform(0.24, 0.34)
    width = site.random.uniform(0.4, 1.2)
    site.floor()
    for k in range(count):
        end = edge + (k + 1) * run if k < count - 1 else edge + count * run + 3
        level = (k + 1) * rise
        site.piece(slab(edge + k * run, end, level, level, (-width, width)), OBSTACLE, level)
    site.stairs = {'direction': 'up', 'count': count, 'rise': rise, 'run': run}


def _ramp(site: _Site) -> None:
    foot, length = site.ahead(), site.random.uniform(0.8, 3)
    # Not so steep that the ramp down hides behind its edge.
    hidden = np.degrees(np.arctan2(site.height, foot))
    steepest = 11 if site.kind == 'ramp up' else min(11, 0.7 * hidden)
    tangent = np.tan(np.radians(site.random.uniform(0.4, 1) * steepest))
    top = length * (tangent if site.kind == 'ramp up' else -tangent)
    site.floor(end=foot)
    site.floor(foot, foot + length, 0, top)
    site.floor(foot + length, _FAR, top, top)


def _steep(site: _Site) -> None:
    foot, length = site.ahead(), site.random.uniform(0.5, 1.5)
    tangent = np.tan(np.radians(site.random.uniform(18, 40)))
    if site.random.random() < 0.6:
        site.floor()
        top = length * tangent
        site.piece(slab(foot, foot + length, 0, top, ALL), OBSTACLE, top)
        site.piece(slab(foot + length, _FAR, top, top, ALL), OBSTACLE, top)
    else:
        top = -length * tangent
        site.floor(end=foot)
        site.continued(foot)
        site.piece(slab(foot, foot + length, 0, top, ALL), DROP, -top)
        site.piece(slab(foot + length, _FAR, top, top, ALL), DROP, -top)


def _curb(site: _Site) -> None:
    start, height = site.ahead(), float(site.random.choice([0.05, 0.06, 0.08, 0.1, 0.15]))
    side = site.random.uniform(-1.0, 0.3)
    site.floor()
    site.piece(slab(start, _FAR, height, height, (side, _WIDE)), OBSTACLE, height)


def _mirror(site: _Site) -> None:
    start = site.ahead(0.2, 1.0)
    length, side = site.random.uniform(0.4, 1.2), site.random.uniform(0.2, 0.7)
    site.floor()
    # Ahead of the other pieces: a mirror in the floor, a hair above it.
    site.piece(slab(start, start + length, 1e-6, 1e-6, (-side, side)), DROP, 1.0, 'mirror')
    site.walls()


def _table_in_front(site: _Site) -> None:
    site.floor()
    site.table(site.near + site.random.uniform(0.0, 0.3))
    site.boxes(1)


def _filled(site: _Site) -> None:
    site.floor()
    ahead = max(site.near - 0.1, 0.4) + site.random.uniform(0, 0.15)
    if site.random.random() < 0.5:
        site.piece(box((1, 20, 12), np.eye(3), (ahead + 0.5, 0, 0)), OBSTACLE, 3.0)
    else:
        size = site.random.uniform(0.5, 1.5)
        site.piece(box((1, 4, size), np.eye(3), (ahead + 0.5, 0, size / 2)), OBSTACLE, size)


def _no_floor(site: _Site) -> None:
    site.pitch = site.random.uniform(0, 3)
    site.height = site.random.uniform(1.2, 1.6)
    site.floor()
    ahead = site.random.uniform(0.9, 2.2)
    site.piece(box((1, 20, 12), np.eye(3), (ahead + 0.5, 0, 0)), OBSTACLE, 3.0)


def _on_ramp(site: _Site) -> None:
    slope = site.random.uniform(4, 10) * site.random.choice([-1, 1])
    end = site.ahead(0.8, 3)
    tangent = np.tan(np.radians(slope))
    site.pitch = float(np.clip(site.pitch - slope, 0, 60))
    site.floor(-3, end, -3 * tangent, end * tangent)
    site.floor(end, _FAR, end * tangent, end * tangent)


def _overhead(site: _Site) -> None:
    site.floor()
    site.walls()
    start, height = site.ahead(0.5, 1.5), site.random.uniform(0.5, 1.4)
    site.piece(
        box((site.random.uniform(0.1, 0.5), 3, 0.1), np.eye(3), (start, 0, height)),
        OBSTACLE,
        height,
    )


KINDS: dict[str, Callable[[_Site], None]] = {
    'room': _room,
    'low boxes': _low,
    'clutter': _clutter,
    'waves': _wavy,
    'drop': _drop,
    'hole': _hole,
    'pit': _hole,
    'stairs down': _stairs_down,
    'stairs up': _stairs_up,
    'ramp up': _ramp,
    'ramp down': _ramp,
    'steep': _steep,
    'curb': _curb,
    'mirror': _mirror,
    'table in front': _table_in_front,
    'filled view': _filled,
    'no floor': _no_floor,
    'robot on a ramp': _on_ramp,
    'overhead': _overhead,
}
"""What there is on the way, by kind."""


def terrain_scene(kind: str, seed: int) -> Terrain:
    """A terrain of that kind; the same seed gives the same terrain."""
    site = _Site(kind, seed)
    KINDS[kind](site)
    return site.terrain()


def stated(scene: Terrain, seed: int) -> tuple[NDArray[np.float64], float]:
    """Up and the sensor's height as a robot knows them: off by 1 degree per axis and 1 cm."""
    random = np.random.default_rng([seed, 13])
    signs = random.choice([-1.0, 1.0], 4)
    wrong = Rotation.from_euler('xyz', signs[:3], degrees=True)
    up: NDArray[np.float64] = wrong.apply(scene.up)
    ground = sum(float(wave.height(np.zeros(3))) for wave in scene.waves)
    return up, float(scene.pose.position[2] - ground + 0.01 * signs[3])
