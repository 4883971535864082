"""Kinds of terrains: rooms, drops, stairs, ramps, mirrors and what else is on the way.

World frame: x ahead, y to the left, z up, metres; the robot stands at the origin on z = 0.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.ground.classes import DROP, GROUND, OBSTACLE
from rangeseg_ros.simulation.solids import box
from rangeseg_ros.simulation.terrain.hard import HARD
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, WIDE, Terrain, Wave, slab
from rangeseg_ros.simulation.terrain.site import Site


def _room(site: Site) -> None:
    site.floor()
    site.walls()
    site.boxes(int(site.random.integers(1, 4)))


def _low(site: Site) -> None:
    site.floor()
    site.boxes(int(site.random.integers(3, 7)))


def _clutter(site: Site) -> None:
    site.floor()
    site.walls()
    site.table(site.ahead(0.4, 1.5))
    site.poles(int(site.random.integers(1, 4)))
    site.cable()


def _wavy(site: Site) -> None:
    site.floor()
    site.boxes(2)
    length = site.random.uniform(1.5, 3, 2)
    site.waves = tuple(
        Wave(site.random.uniform(0.005, 0.015), 2 * np.pi / m, site.random.uniform(-1, 1), p)
        for m, p in zip(length, site.random.uniform(0, 6, 2), strict=True)
    )


def _drop(site: Site) -> None:
    edge = site.ahead()
    depth = float(site.random.choice([0.05, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0]))
    site.floor(end=edge)
    site.continued(edge)
    site.piece(slab(edge, FAR, -depth, -depth, ALL), DROP, depth)


def _hole(site: Site) -> None:
    start = site.ahead(0.2, 1.0)
    end, side = start + site.random.uniform(0.3, 0.9), site.random.uniform(0.2, 0.8)
    middle = site.random.uniform(-0.3, 0.3)
    depth = float(site.random.choice([0.06, 0.1, 0.2, 0.4]))
    near, far = (start, end), (middle - side, middle + side)
    site.floor(end=near[0])
    site.floor(start=near[1])
    site.continued(*near)
    for y in ((-WIDE, far[0]), (far[1], WIDE)):
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


def _stairs_down(site: Site) -> None:
    edge, count = site.ahead(0.2, 1.2), int(site.random.integers(3, 9))
    rise, run = site.random.uniform(0.12, 0.2), site.random.uniform(0.24, 0.34)
    site.floor(end=edge)
    site.continued(edge)
    for k in range(count):
        end = edge + (k + 1) * run if k < count - 1 else FAR
        level = -(k + 1) * rise
        site.piece(slab(edge + k * run, end, level, level, ALL), DROP, -level)
    site.stairs = {'direction': 'down', 'count': count, 'rise': rise, 'run': run}


def _stairs_up(site: Site) -> None:
    edge, count = site.ahead(0.4, 1.8), int(site.random.integers(3, 9))
    rise, run = site.random.uniform(0.12, 0.2), site.random.uniform(0.24, 0.34)
    width = site.random.uniform(0.4, 1.2)
    site.floor()
    for k in range(count):
        end = edge + (k + 1) * run if k < count - 1 else edge + count * run + 3
        level = (k + 1) * rise
        site.piece(slab(edge + k * run, end, level, level, (-width, width)), OBSTACLE, level)
    site.stairs = {'direction': 'up', 'count': count, 'rise': rise, 'run': run}


def _ramp(site: Site) -> None:
    foot, length = site.ahead(), site.random.uniform(0.8, 3)
    # Not so steep that the ramp down hides behind its edge.
    hidden = np.degrees(np.arctan2(site.height, foot))
    steepest = 11 if site.kind == 'ramp up' else min(11, 0.7 * hidden)
    tangent = np.tan(np.radians(site.random.uniform(0.4, 1) * steepest))
    top = length * (tangent if site.kind == 'ramp up' else -tangent)
    site.floor(end=foot)
    site.floor(foot, foot + length, 0, top)
    site.floor(foot + length, FAR, top, top)


def _steep(site: Site) -> None:
    foot, length = site.ahead(), site.random.uniform(0.5, 1.5)
    tangent = np.tan(np.radians(site.random.uniform(18, 40)))
    if site.random.random() < 0.6:
        site.floor()
        top = length * tangent
        site.piece(slab(foot, foot + length, 0, top, ALL), OBSTACLE, top)
        site.piece(slab(foot + length, FAR, top, top, ALL), OBSTACLE, top)
    else:
        top = -length * tangent
        site.floor(end=foot)
        site.continued(foot)
        site.piece(slab(foot, foot + length, 0, top, ALL), DROP, -top)
        site.piece(slab(foot + length, FAR, top, top, ALL), DROP, -top)


def _curb(site: Site) -> None:
    start, height = site.ahead(), float(site.random.choice([0.05, 0.06, 0.08, 0.1, 0.15]))
    side = site.random.uniform(-1.0, 0.3)
    site.floor()
    site.piece(slab(start, FAR, height, height, (side, WIDE)), OBSTACLE, height)


def _mirror(site: Site) -> None:
    start = site.ahead(0.2, 1.0)
    length, side = site.random.uniform(0.4, 1.2), site.random.uniform(0.2, 0.7)
    site.floor()
    # Ahead of the other pieces: a mirror in the floor, a hair above it.
    site.piece(slab(start, start + length, 1e-6, 1e-6, (-side, side)), DROP, 1.0, 'mirror')
    site.walls()


def _table_in_front(site: Site) -> None:
    site.floor()
    site.table(site.near + site.random.uniform(0.0, 0.3))
    site.boxes(1)


def _filled(site: Site) -> None:
    site.floor()
    ahead = max(site.near - 0.1, 0.4) + site.random.uniform(0, 0.15)
    if site.random.random() < 0.5:
        site.piece(box((1, 20, 12), np.eye(3), (ahead + 0.5, 0, 0)), OBSTACLE, 3.0)
    else:
        size = site.random.uniform(0.5, 1.5)
        site.piece(box((1, 4, size), np.eye(3), (ahead + 0.5, 0, size / 2)), OBSTACLE, size)


def _no_floor(site: Site) -> None:
    site.pitch = site.random.uniform(0, 3)
    site.height = site.random.uniform(1.2, 1.6)
    site.floor()
    ahead = site.random.uniform(0.9, 2.2)
    site.piece(box((1, 20, 12), np.eye(3), (ahead + 0.5, 0, 0)), OBSTACLE, 3.0)


def _on_ramp(site: Site) -> None:
    slope = site.random.uniform(4, 10) * site.random.choice([-1, 1])
    end = site.ahead(0.8, 3)
    tangent = np.tan(np.radians(slope))
    site.pitch = float(np.clip(site.pitch - slope, 0, 60))
    site.floor(-3, end, -3 * tangent, end * tangent)
    site.floor(end, FAR, end * tangent, end * tangent)


def _overhead(site: Site) -> None:
    site.floor()
    site.walls()
    start, height = site.ahead(0.5, 1.5), site.random.uniform(0.5, 1.4)
    site.piece(
        box((site.random.uniform(0.1, 0.5), 3, 0.1), np.eye(3), (start, 0, height)),
        OBSTACLE,
        height,
    )


KINDS: dict[str, Callable[[Site], None]] = {
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
    """A terrain of a kind of `KINDS` or `HARD`; the same seed gives the same terrain."""
    site = Site(kind, seed)
    {**KINDS, **HARD}[kind](site)
    return site.terrain()


def stated(scene: Terrain, seed: int) -> tuple[NDArray[np.float64], float]:
    """Up and the sensor's height as a robot knows them: off by the errors of the scene."""
    random = np.random.default_rng([seed, 13])
    signs = random.choice([-1.0, 1.0], 4)
    wrong = Rotation.from_euler('xyz', scene.errors[0] * signs[:3], degrees=True)
    up: NDArray[np.float64] = wrong.apply(scene.up)
    ground = sum(float(wave.height(np.zeros(3))) for wave in scene.waves)
    return up, float(scene.pose.position[2] - ground + scene.errors[1] * signs[3])
