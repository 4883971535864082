"""Random scenes of solids, and where the camera stands in them.

World frame: x and y along the floor, z up, metres; the floor is z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.simulation.solids import Solid, about_z, box, cast, cylinder, half_space, sphere

OPTICAL_IN_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of the optical frame (z forward, REP 103) in a body frame with x forward, z up."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a sensor stands: world-from-sensor rotation (3, 3), and its origin (3,), metres."""

    rotation: Floats
    position: Floats

    @classmethod
    def looking(cls, position: ArrayLike, yaw: float, pitch: float, roll: float) -> Pose:
        """Camera at `position` looking along `yaw`, down by `pitch`, turned by `roll` (degrees).

        Yaw is measured from the world's x axis; roll about the optical axis.
        """
        body = Rotation.from_euler('ZYX', [yaw, pitch, roll], degrees=True).as_matrix()
        return cls(body @ OPTICAL_IN_BODY, np.asarray(position, np.float64))


@dataclass(frozen=True, eq=False)
class Scene:
    """Solids, the poses of the camera that looks at them, one per frame, and dark places.

    `dark` (N, 4) are centres and radii of balls in which surfaces return too little light to be
    measured.
    """

    solids: tuple[Solid, ...]
    poses: tuple[Pose, ...]
    dark: Floats = field(default_factory=lambda: np.zeros((0, 4)))

    def planes(self, pose: Pose) -> Floats:
        """(F, 4) equations (normal, distance) of all faces in the frame of a sensor at `pose`.

        Normals point out of the solids, so towards the sensor on every visible face; NaN for
        curved faces.
        """
        world = np.vstack([solid.planes for solid in self.solids])
        distance = world[:, :3] @ pose.position + world[:, 3]
        return np.column_stack([world[:, :3] @ pose.rotation, distance])


def camera_motion(start: Pose, seed: int, frames: int) -> tuple[Pose, ...]:
    """Hand-held motion about a pose, smooth and seeded, at 30 frames per second.

    Each of the six coordinates swings sinusoidally with its own period of 3 to 6 s, by up to
    0.3 m and 16 degrees from end to end: about 0.3 m/s and 15 degrees/s at the fastest. The first
    pose is `start`.
    """
    random = np.random.default_rng([seed, 3])
    period, phase = random.uniform(3, 6, 6), random.uniform(0, 2 * np.pi, 6)
    amplitude = np.array([0.15, 0.15, 0.08, 4.0, 8.0, 3.0]) * random.uniform(0.6, 1, 6)
    time = np.arange(frames)[:, None] / 30
    swing = np.sin(2 * np.pi * time / period + phase) - np.sin(phase)
    shift, turn = np.split(amplitude * swing, 2, axis=1)
    turned = Rotation.from_euler('xyz', turn, degrees=True).as_matrix()
    return tuple(
        Pose(start.rotation @ rotation, start.position + offset)
        for rotation, offset in zip(turned, shift, strict=True)
    )


def walk(start: Pose, seed: int, frames: int) -> tuple[Pose, ...]:
    """Walk with the camera in the hand along an arc about the room, at 30 frames per second.

    From one side to the other and back at up to 0.5 m/s, 1.2 m to both sides, looking at the
    middle of the room, with the swings of `camera_motion` on top. `start` is over the origin and
    looks along x, as in `kinect_room`.
    """
    middle, reach, period = 2.2, 0.55, 16.0
    swings = camera_motion(start, seed, frames)
    angle = reach * np.sin(2 * np.pi * np.arange(frames) / 30 / period)
    turned = Rotation.from_euler('z', -angle[:, None]).as_matrix()
    poses = []
    for rotation, pose in zip(turned, swings, strict=True):
        about = pose.position - (middle, 0, 0)
        poses.append(Pose(rotation @ pose.rotation, rotation @ about + (middle, 0, 0)))
    return tuple(poses)


Motion = Callable[[Pose, int, int], tuple[Pose, ...]]
"""Poses from a first one, a seed and a number of frames."""


def kinect_room(seed: int, frames: int = 1, motion: Motion = camera_motion) -> Scene:
    """Floor, two walls and three to five boxes at any orientation, as a hand-held Kinect sees it.

    The boxes rest on the floor, stand on one another, lie tilted or float; the camera is 0.8 to
    1.8 m above the floor and tilted down; depth is about 0.8 to 5 m.

    The same seed gives the same room and, for its first frames, the same motion.
    """
    random = np.random.default_rng([seed, 1])
    room = _Room(random)
    for _ in range(random.integers(3, 6)):
        room.add_box()
    return room.scene(motion(room.pose, seed, frames))


def curved_scene(seed: int, frames: int = 1) -> Scene:
    """`kinect_room` with a ball, a standing cylinder, and one or two boxes."""
    random = np.random.default_rng([seed, 2])
    # The curved objects stand in front, so that no box hides them.
    room = _Room(random, nearest=2.5)
    room.add_ball()
    room.add_cylinder()
    for _ in range(random.integers(1, 3)):
        room.add_box()
    return room.scene(camera_motion(room.pose, seed, frames))


class _Room:
    """A room under construction: the camera above the origin looks along x into a corner."""

    def __init__(self, random: np.random.Generator, nearest: float = 1.0) -> None:
        self.random = random
        self.nearest = nearest
        self.height = random.uniform(0.8, 1.8)
        # The higher the camera, the more it looks down.
        pitch = random.uniform(8, 20) + 12 * (self.height - 0.8)
        self.pose = Pose.looking((0, 0, self.height), 0, pitch, random.uniform(-4, 4))
        self.depth = random.uniform(3.0, 4.4)
        # The corner to the left (1) or right (-1), the side wall not running away from the view.
        side = random.choice([-1, 1])
        turn = -side * np.radians(random.uniform(0, 25))
        corner = np.radians(random.uniform(80, 100))
        back = np.array([-np.cos(turn), -np.sin(turn), 0])
        beside = np.array([-np.cos(turn + side * corner), -np.sin(turn + side * corner), 0])
        self.walls = [
            half_space(back, (self.depth, 0, 0)),
            half_space(beside, -random.uniform(0.9, 1.6) * beside),
        ]
        self.solids = [half_space((0, 0, 1), (0, 0, 0)), *self.walls]
        self.occupied: list[tuple[Floats, float]] = []
        self.tops: list[tuple[Floats, float, float, float]] = []

    def add_box(self) -> None:
        """Add a box: resting on the floor, stacked, or tilted and perhaps floating."""
        kind = self.random.choice(['resting', 'stacked', 'tilted'], p=[0.45, 0.2, 0.35])
        size = self.random.uniform(0.2, 0.8, 3)
        if kind == 'stacked' and self.tops:
            place, top, width, yaw = self.tops.pop(self.random.integers(len(self.tops)))
            size[:2] = self.random.uniform(0.4, 0.9, 2) * width
            size[2] = self.random.uniform(0.1, 0.4)
            angle = yaw + self.random.uniform(-20, 20)
            self.solids.append(box(size, about_z(angle), (*place, top + size[2] / 2)))
        elif kind == 'tilted':
            rotation = Rotation.from_quat(self.random.standard_normal(4)).as_matrix()
            reach = np.abs(rotation) @ size / 2
            lift = max(self.random.uniform(-0.4, 0.5), 0)
            place = self._free_place(np.hypot(*reach[:2]), self.nearest, self.depth)
            self.solids.append(box(size, rotation, (*place, reach[2] + lift)))
        else:
            yaw = self.random.uniform(0, 90)
            place = self._free_place(np.hypot(*size[:2]) / 2, self.nearest, self.depth)
            self.solids.append(box(size, about_z(yaw), (*place, size[2] / 2)))
            self.tops.append((place, size[2], min(size[:2]), yaw))

    def add_ball(self) -> None:
        """Add a ball that lies on the floor."""
        radius = self.random.uniform(0.15, 0.3)
        self.solids.append(sphere(radius, (*self._free_place(radius, 1.3, 2.3), radius)))

    def add_cylinder(self) -> None:
        """Add a cylinder that stands on the floor."""
        radius, height = self.random.uniform(0.1, 0.25), self.random.uniform(0.4, 0.9)
        place = self._free_place(radius, 1.3, 2.3)
        self.solids.append(cylinder(radius, height, np.eye(3), (*place, height / 2)))

    def scene(self, poses: tuple[Pose, ...]) -> Scene:
        """The finished room, with up to three dark places of 3 to 6 degrees radius in view."""
        count = self.random.integers(4)
        view = self.random.uniform((-0.45, -0.3, 1), (0.45, 0.3, 1), (count, 3))
        rays = view @ self.pose.rotation.T
        distance, _ = cast(self.solids, self.pose.position, rays)
        centres = self.pose.position + distance[:, None] * rays
        radii = distance * np.radians(self.random.uniform(3, 6, len(rays)))
        return Scene(tuple(self.solids), poses, np.column_stack([centres, radii]))

    def _free_place(self, radius: float, near: float, far: float) -> Floats:
        """(x, y) of an upright cylinder of that radius that is in view and touches nothing.

        After many failures the objects may overlap; they are then cast as one body.
        """
        for _ in range(1000):
            place = self.random.uniform((near, -1.4), (far, 1.4))
            free = np.hypot(*place) - radius > 0.8 and abs(place[1]) < 0.45 * place[0]
            for wall in self.walls:
                free &= wall.planes[0] @ (*place, 0, 1) > radius
            for other, reach in self.occupied:
                free &= np.hypot(*(place - other)) > radius + reach
            if free:
                break
        self.occupied.append((place, radius))
        return place
