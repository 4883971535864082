"""Scenes like those of the segmentation comparison: polyhedra on a floor before a wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rangeseg_ros.simulation.scenes import Pose, Scene
from rangeseg_ros.simulation.solids import Solid, half_space, prism


def polyhedral_scene(
    seed: int, distance: float, width: float, pitch: tuple[float, float]
) -> Scene:
    """Three to seven boxes, wedges and five- or six-sided prisms on a floor before a wall.

    They stand or lie on the floor or on one another, or lean; some hide others. The numbers are
    chosen to give about the 15 regions that an image of the real sets has on average.

    Parameters
    ----------
    seed : int
        The same seed gives the same scene.
    distance : float
        From the sensor to the point of the floor it looks at, metres.
    width : float
        Width of the field of view at that distance, metres; objects measure 0.1 to 0.27 of it.
    pitch : (float, float)
        Range of the angle by which the sensor looks down, degrees.
    """
    random = np.random.default_rng([seed, 6])
    down = random.uniform(*pitch)
    angle = np.radians(down)
    pose = Pose.looking(
        (-distance * np.cos(angle), 0, distance * np.sin(angle)), 0, down, random.uniform(-3, 3)
    )
    turn = np.radians(random.uniform(-20, 20))
    wall = half_space((-np.cos(turn), -np.sin(turn), 0), (width * random.uniform(0.2, 0.35), 0, 0))
    table = _Table(random, width, wall)
    for _ in range(random.integers(3, 8)):
        table.add()
    return Scene((half_space((0, 0, 1), (0, 0, 0)), wall, *table.solids), (pose,))


class _Table:
    """Objects placed so far around the origin of the floor."""

    def __init__(self, random: np.random.Generator, width: float, wall: Solid) -> None:
        self.random, self.width, self.wall = random, width, wall
        self.solids: list[Solid] = []
        self.occupied: list[tuple[NDArray[np.float64], float]] = []
        self.tops: list[tuple[NDArray[np.float64], float]] = []

    def add(self) -> None:
        """Add an object on a free place, or on another object."""
        sides = self.random.choice([3, 4, 5, 6], p=[0.25, 0.45, 0.15, 0.15])
        scale = self.width * self.random.uniform(0.1, 0.27, 3)
        pose = self.random.choice(['standing', 'lying', 'leaning'], p=[0.5, 0.35, 0.15])
        stacked = len(self.tops) > 0 and pose != 'leaning' and self.random.random() < 0.25
        if stacked:
            scale = scale / 2
        outline, height = _outline(int(sides), scale[0], scale[1]), scale[2]
        rotation = Rotation.from_euler('z', self.random.uniform(0, 360), degrees=True)
        if pose == 'lying':
            # The outline upright, its first edge on the floor.
            rotation = rotation * Rotation.from_euler('x', 90, degrees=True)
        elif pose == 'leaning':
            rotation = Rotation.from_quat(self.random.standard_normal(4))
        base = np.column_stack([outline, np.full(len(outline), height / 2)])
        corners = rotation.apply(np.vstack([base, base * (1, 1, -1)]))
        reach, bottom = np.hypot(*corners[:, :2].T).max(), corners[:, 2].min()
        if stacked:
            place, level = self.tops.pop(self.random.integers(len(self.tops)))
        else:
            found = self._free_place(reach)
            if found is None:
                return
            place, level = found, 0.0
        matrix = rotation.as_matrix()
        self.solids.append(prism(outline, height, matrix, (*place, level - bottom)))
        if pose == 'standing' or (pose == 'lying' and sides == 4):
            self.tops.append((place, level + corners[:, 2].max() - bottom))

    def _free_place(self, reach: float) -> NDArray[np.float64] | None:
        """(x, y) of an upright cylinder of that radius that touches nothing, if there is room."""
        for _ in range(300):
            place = self.random.uniform((-0.25, -0.45), (0.3, 0.45)) * self.width
            gap = self.wall.normals[0, :2] @ place + self.wall.offsets[0] - reach
            if gap > 0 and all(
                np.hypot(*(place - other)) > reach + radius for other, radius in self.occupied
            ):
                self.occupied.append((place, reach))
                return place
        return None


def _outline(sides: int, width: float, depth: float) -> NDArray[np.float64]:
    """Counter-clockwise outline about the origin, its first edge at the bottom along x."""
    if sides == 3:
        corners = np.array([[-0.5, -1 / 3], [0.5, -1 / 3], [-0.5, 2 / 3]])
    else:
        angle = 2 * np.pi * (np.arange(sides) - 0.5) / sides - np.pi / 2
        corners = np.column_stack([np.cos(angle), np.sin(angle)])
        corners /= np.ptp(corners, axis=0)
    return corners * (width, depth)
