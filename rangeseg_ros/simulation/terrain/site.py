"""A terrain under construction: what is put where, in reach of the camera.

World frame: x ahead, y to the left, z up, metres; the robot stands at the origin on z = 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.ground.classes import GROUND, OBSTACLE
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.solids import Solid, box, cylinder
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, Piece, Terrain, Wave, slab


class Site:
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
        # What the robot is told wrongly: degrees of up about each axis, metres of height.
        self.errors = (1.0, 0.01)
        self.relief = 0.0

    def ahead(self, least: float = 0.25, most: float = 1.4) -> float:
        """Somewhere beyond where the ground comes into view."""
        return self.near + self.random.uniform(least, most)

    def floor(self, start: float = -3, end: float = FAR, low: float = 0, high: float = 0) -> None:
        """Ground that is there."""
        solid = slab(start, end, low, high, ALL)
        self.pieces.append(Piece(solid, GROUND))
        self.ground.append(solid)

    def continued(self, start: float, end: float = FAR) -> None:
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
            self.kind,
            tuple(self.pieces),
            tuple(self.ground),
            pose,
            self.waves,
            self.stairs,
            self.errors,
            self.relief,
        )


def _turned(random: np.random.Generator) -> NDArray[np.float64]:
    rotation: NDArray[np.float64] = Rotation.from_euler(
        'z', random.uniform(0, 90), degrees=True
    ).as_matrix()
    return rotation
