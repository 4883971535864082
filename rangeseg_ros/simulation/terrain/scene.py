"""What a terrain is made of, and how one is put together within reach of the camera.

World frame: x ahead, y to the left, z up, metres; the robot stands at the origin on z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.solids import Solid, about_z, box, cylinder, prism

FAR, WIDE = 12.0, 8.0
"""Where the ground ends, ahead and to either side, metres."""
ALL = (-WIDE, WIDE)
"""All of its width."""


class Wave(NamedTuple):
    """Undulation of the ground: amplitude (m), wave numbers along x and y (1/m), phase."""

    amplitude: float
    along: float
    across: float
    phase: float


class Piece(NamedTuple):
    """A solid and what it is to a robot: its class of terrain.

    `size` tells how far the whole object stands above the ground, or how deep the drop is, metres;
    `seen` whether the 'surface' is measured, the 'mirror' image behind it, or 'nothing'.
    """

    solid: Solid
    terrain: int
    size: float = 0.0
    seen: str = 'surface'


@dataclass(frozen=True, eq=False)
class Terrain:
    """A scene: what there is, the ground as if nothing interrupted it, and the camera.

    `ground` is that without holes and edges; the waves are added to it, and to rough ground noise
    of the standard deviation `relief`, metres. `stairs` has `direction`, `count`, `rise`, `run` of
    a staircase, or nothing; `errors` are those of what the robot is told: degrees of up about each
    axis, metres of the height.
    """

    kind: str
    pieces: Sequence[Piece]
    ground: Sequence[Solid]
    pose: Pose
    waves: Sequence[Wave] = ()
    stairs: dict[str, float | str] = field(default_factory=dict)
    errors: tuple[float, float] = (1.0, 0.01)
    relief: float = 0.0

    @property
    def up(self) -> Floats:
        """Up in the optical frame."""
        return self.pose.rotation[2]

    def wave_height(self, points: Floats) -> Floats:
        """(...) height of the waves at points (..., 3)."""
        height = np.zeros(points.shape[:-1])
        for wave in self.waves:
            angle = wave.along * points[..., 0] + wave.across * points[..., 1] + wave.phase
            height += wave.amplitude * np.sin(angle)
        return height


def slab(start: float, end: float, low: float, high: float, y: tuple[float, float]) -> Solid:
    """Ground from x = start to end, rising from z = low to high, 3 m deep, between two y."""
    bottom = min(low, high) - 3.0
    outline = np.array([(start, bottom), (end, bottom), (end, high), (start, low)])
    # The prism's own x, y, z are the world's x, z, -y.
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return prism(outline, y[1] - y[0], rotation, (0, (y[0] + y[1]) / 2, 0))


class Site:
    """A terrain under construction: the robot looks along x. See `Terrain` for the attributes."""

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
        self.errors = (1.0, 0.01)
        self.relief = 0.0

    def terrain(self) -> Terrain:
        """The finished scene."""
        yaw = self.random.uniform(-12, 12)
        pose = Pose.looking((0, 0, self.height), yaw, self.pitch, self.roll)
        more = self.waves, self.stairs, self.errors, self.relief
        return Terrain(self.kind, self.pieces, self.ground, pose, *more)

    def ahead(self, least: float = 0.25, most: float = 1.4) -> float:
        """Somewhere beyond where the ground comes into view."""
        return self.near + self.random.uniform(least, most)

    def one_of(self, *values: float) -> float:
        """One of some values."""
        return float(self.random.choice(values))

    def piece(self, solid: Solid, terrain: int, size: float, seen: str = 'surface') -> None:
        """See `Piece`."""
        self.pieces.append(Piece(solid, terrain, size, seen))

    def floor(self, start: float = -3, end: float = FAR, low: float = 0, high: float = 0) -> None:
        """Ground that is there."""
        solid = slab(start, end, low, high, ALL)
        self.pieces.append(Piece(solid, GROUND))
        self.ground.append(solid)

    def continued(self, start: float, end: float = FAR) -> None:
        """Ground that is not there."""
        self.ground.append(slab(start, end, 0, 0, ALL))

    def off_level(
        self, start: float, end: float, low: float, high: float, y: tuple[float, float] = ALL
    ) -> None:
        """A slab that ends at z = high: above the ground an obstacle, below it a drop."""
        self.piece(slab(start, end, low, high, y), OBSTACLE if high > 0 else DROP, abs(high))

    def step(self, start: float, height: float) -> None:
        """Floor that goes on so much higher, or lower, from `start` on, all across."""
        self.slope(start, 0, height)

    def slope(self, start: float, length: float, height: float) -> None:
        """Floor that rises, or falls, by `height` on a length, steeper than ground may be."""
        self.floor(end=start)
        self.continued(start)
        if length:
            self.off_level(start, start + length, 0, height)
        self.off_level(start + length, FAR, height, height)

    def gap(self, start: float, width: float) -> None:
        """A gap all across, 1 m deep; the ground behind it is not judged."""
        self.floor(end=start)
        self.continued(start, start + width)
        self.off_level(start, start + width, -1, -1)
        self.continued(start + width)
        self.piece(self.ground[-1], UNKNOWN, 0.0)

    def wall(self, ahead: float) -> None:
        """A wall all across."""
        self.piece(box((1, 20, 12), np.eye(3), (ahead + 0.5, 0, 0)), OBSTACLE, 3.0)

    def walls(self) -> None:
        """Walls around, and a ceiling."""
        far, side = self.random.uniform(4, 7), self.random.uniform(1.5, 3)
        self.wall(far)
        for centre, size in (
            ((0, side + 0.5, 0), (20, 1, 12)),
            ((0, -side - 0.7, 0), (20, 1, 12)),
            ((0, 0, self.random.uniform(2.3, 3) + 0.5), (20, 20, 1)),
        ):
            self.piece(box(size, np.eye(3), centre), OBSTACLE, 3.0)

    def boxes(self, count: int) -> None:
        """Boxes from 3 cm on the ground."""
        for _ in range(count):
            height = self.one_of(0.03, 0.05, 0.06, 0.08, 0.1, 0.15, 0.25, 0.5)
            size = (*self.random.uniform(0.12, 0.6, 2), height)
            place = self.ahead(0.2, 2.2), self.random.uniform(-0.8, 0.8), height / 2
            turn = about_z(self.random.uniform(0, 90))
            self.piece(box(size, turn, place), OBSTACLE, height)

    def poles(self, count: int) -> None:
        """Legs and posts of 2 to 6 cm."""
        for _ in range(count):
            place = self.ahead(0.2, 2.0), self.random.uniform(-0.8, 0.8)
            height = self.random.uniform(0.3, 1.5)
            radius = self.random.uniform(0.01, 0.03)
            pole = cylinder(radius, height, np.eye(3), (*place, height / 2))
            self.piece(pole, OBSTACLE, height)

    def cable(self) -> None:
        """A cable or bar of 1 to 3 cm that hangs across."""
        height, radius = self.random.uniform(0.08, 0.6), self.random.uniform(0.005, 0.015)
        lying = Rotation.from_euler('x', 90, degrees=True).as_matrix()
        turn = about_z(self.random.uniform(-30, 30)) @ lying
        cable = cylinder(radius, 3, turn, (self.ahead(), 0, height))
        self.piece(cable, OBSTACLE, height + radius)

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
