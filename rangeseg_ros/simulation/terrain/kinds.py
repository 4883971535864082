"""Kinds of terrains: what is on the way of a robot, and what is easily confused with ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.simulation.solids import box
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, WIDE, Site, Terrain, Wave, slab

# Tangent of the lowest ray that a sensor of 58 degrees sees when it looks down by up to 20.
_BLIND = 1.15


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


def _hole(site: Site) -> None:
    near = site.ahead(0.2, 1.0)
    far, side = near + site.random.uniform(0.3, 0.9), site.random.uniform(0.2, 0.8)
    middle = site.random.uniform(-0.3, 0.3)
    depth = site.one_of(0.06, 0.1, 0.2, 0.4)
    right, left = middle - side, middle + side
    site.floor(end=near)
    site.floor(start=far)
    site.continued(near, far)
    for y in ((-WIDE, right), (left, WIDE)):
        site.piece(slab(near, far, 0, 0, y), GROUND, 0)
    # The sides of the hole belong to it.
    for solid in (
        slab(near, far, -depth, -depth, (right, left)),
        slab(far - 0.01, far, -0.002, -0.002, (right, left)),
        slab(near, far, -0.002, -0.002, (right, right + 0.01)),
        slab(near, far, -0.002, -0.002, (left - 0.01, left)),
    ):
        site.piece(solid, DROP, depth, 'nothing' if site.kind == 'pit' else 'surface')


def _stairs(site: Site) -> None:
    up = site.kind == 'stairs up'
    edge = site.ahead(0.4, 1.8) if up else site.ahead(0.2, 1.2)
    count = int(site.random.integers(3, 9))
    rise, run = site.random.uniform(0.12, 0.2), site.random.uniform(0.24, 0.34)
    if up:
        width = site.random.uniform(0.4, 1.2)
        end, across = edge + count * run + 3, (-width, width)
        site.floor()
    else:
        end, across = FAR, ALL
        site.floor(end=edge)
        site.continued(edge)
    ends = [edge + k * run for k in range(count)] + [end]
    for k in range(count):
        level = (k + 1) * (rise if up else -rise)
        site.off_level(ends[k], ends[k + 1], level, level, across)
    direction = 'up' if up else 'down'
    site.stairs = {'direction': direction, 'count': count, 'rise': rise, 'run': run}


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
    site.slope(foot, length, length * tangent * (1 if site.random.random() < 0.6 else -1))


def _curb(site: Site) -> None:
    start, height = site.ahead(), site.one_of(0.05, 0.06, 0.08, 0.1, 0.15)
    site.floor()
    site.off_level(start, FAR, height, height, (site.random.uniform(-1.0, 0.3), WIDE))


def _mirror(site: Site) -> None:
    start = site.ahead(0.2, 1.0)
    length, side = site.random.uniform(0.4, 1.2), site.random.uniform(0.2, 0.7)
    site.floor()
    # Ahead of the other pieces: a mirror in the floor, a hair above it.
    site.piece(slab(start, start + length, 1e-6, 1e-6, (-side, side)), DROP, 1.0, 'mirror')
    site.walls()


def _table_in_front(site: Site) -> None:
    site.floor()
    site.table(site.ahead(0.0, 0.3))
    site.boxes(1)


def _filled(site: Site) -> None:
    site.floor()
    ahead = max(site.near - 0.1, 0.4) + site.random.uniform(0, 0.15)
    if site.random.random() < 0.5:
        site.wall(ahead)
    else:
        size = site.random.uniform(0.5, 1.5)
        site.piece(box((1, 4, size), np.eye(3), (ahead + 0.5, 0, size / 2)), OBSTACLE, size)


def _no_floor(site: Site) -> None:
    site.pitch = site.random.uniform(0, 3)
    site.height = site.random.uniform(1.2, 1.6)
    site.floor()
    site.wall(site.random.uniform(0.9, 2.2))


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
    bar = box((site.random.uniform(0.1, 0.5), 3, 0.1), np.eye(3), (start, 0, height))
    site.piece(bar, OBSTACLE, height)


def _hidden_step(site: Site) -> None:
    """A level landing behind an edge that is nearer than the view begins."""
    sizes = (0.05, 0.06, 0.08, 0.1, 0.12)
    if site.kind == 'hidden drop':
        height = -site.one_of(*sizes, 0.15, 0.2, 0.3)
    else:
        height = site.one_of(*sizes)
    site.height = site.one_of(0.3, 0.5, 0.8, 1.2)
    site.pitch, site.roll = site.random.uniform(0, 20), site.random.uniform(-3, 3)
    site.step(site.random.uniform(0.2, 0.9) * site.height / _BLIND, height)


def _strip(site: Site) -> None:
    """The edge a few centimetres inside the view."""
    site.height, site.pitch, site.roll = 0.8, site.random.uniform(26, 30), 0.0
    near = site.height / np.tan(np.radians(site.pitch + 21))
    depth = site.one_of(0.06, 0.08, 0.1)
    site.step(near + site.random.uniform(0.03, 0.15), -depth)


def _wrong_height(site: Site) -> None:
    """The stated height is 5 to 15 cm off."""
    site.errors = 1.0, site.one_of(0.05, 0.1, 0.15)
    site.height, site.pitch = 0.8, 28.0
    site.step(site.random.uniform(1.2, 1.6), -site.one_of(0.08, 0.12, 0.17))


def _wrong_up(site: Site) -> None:
    """The stated up is 3 to 5 degrees off about every axis."""
    site.errors = site.random.uniform(2, 3), 0.01
    site.step(site.ahead(), -site.one_of(0.06, 0.1, 0.2))


def _slope(site: Site) -> None:
    """Ground that falls to the side, or rises or falls ahead, at 18 to 45 degrees."""
    angle = np.radians(site.one_of(18, 20, 25, 30, 45))
    if site.random.random() < 0.5:
        side, sign = site.random.uniform(0.1, 0.5), site.one_of(-1, 1)
        site.piece(slab(-3, FAR, 0, 0, (-side, WIDE) if sign > 0 else (-WIDE, side)), GROUND, 0.0)
        site.continued(-3)
        turn = Rotation.from_euler('x', sign * angle).as_matrix()
        middle = np.array([0, -sign * side, 0]) + turn @ (FAR / 2 - 1.5, -sign * WIDE / 2, -1.5)
        site.piece(box((FAR + 3, WIDE, 3), turn, middle), DROP, 1.0)
    else:
        foot, length = site.ahead(), site.random.uniform(0.8, 2)
        up = site.random.random() < 0.5
        site.slope(foot, length, length * np.tan(angle if up else -angle))


def _rough(site: Site) -> None:
    """Relief of 2 or 3 cm, and a hole or a kerb."""
    site.relief = site.one_of(0.02, 0.03)
    start = site.ahead(0.3, 1.0)
    hole, height = site.random.random() < 0.5, site.random.uniform(0.15, 0.4)
    if hole:
        site.step(start, -height)
    else:
        site.floor()
        site.off_level(start, start + 0.5, height, height, (-0.4, 0.4))


def _gap(site: Site) -> None:
    """A gap of 5 to 30 cm all across."""
    site.gap(site.ahead(), site.one_of(0.05, 0.1, 0.15, 0.2, 0.3))


def _open_stairs(site: Site) -> None:
    """Treads without risers, up or down."""
    edge, rise, run = site.ahead(0.2, 1.2), site.random.uniform(0.15, 0.19), 0.28
    down = site.random.random() < 0.5
    site.floor(end=edge if down else FAR)
    site.continued(edge)
    for k in range(6):
        level = (-1 if down else 1) * (k + 1) * rise
        tread = box((run, 2, 0.04), np.eye(3), (edge + (k + 0.5) * run, 0, level - 0.02))
        site.piece(tread, DROP if down else OBSTACLE, abs(level))
    if down:
        site.off_level(edge, FAR, -6 * rise, -6 * rise)


def _bridge(site: Site) -> None:
    """Ground 0.6 to 1.2 m wide with drops beside it."""
    side, depth = site.random.uniform(0.3, 0.6), site.one_of(0.06, 0.1, 0.3, 1.0)
    site.piece(slab(-3, FAR, 0, 0, (-side, side)), GROUND, 0.0)
    site.continued(-3)
    for across in ((-WIDE, -side), (side, WIDE)):
        site.off_level(-3, FAR, -depth, -depth, across)


def _rolled(site: Site) -> None:
    """A camera mounted on its side before an edge."""
    site.roll = site.one_of(-90, 90) + site.random.uniform(-3, 3)
    site.pitch = site.random.uniform(20, 40)
    near = site.height / np.tan(np.radians(site.pitch + 25))
    site.step(near + site.random.uniform(0.3, 1), -site.one_of(0.06, 0.1, 0.3))


KINDS: dict[str, Callable[[Site], None]] = {
    'room': _room,
    'low boxes': _low,
    'clutter': _clutter,
    'waves': _wavy,
    'drop': lambda site: site.step(
        site.ahead(), -site.one_of(0.05, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)
    ),
    'hole': _hole,
    'pit': _hole,
    'stairs down': _stairs,
    'stairs up': _stairs,
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
HARD: dict[str, Callable[[Site], None]] = {
    'hidden drop': _hidden_step,
    'hidden kerb': _hidden_step,
    'strip': _strip,
    'wrong height': _wrong_height,
    'wrong up': _wrong_up,
    'slope': _slope,
    'rough': _rough,
    'gap': _gap,
    'open stairs': _open_stairs,
    'bridge': _bridge,
    'rolled': _rolled,
}
"""What is easily confused, by kind: hidden edges, wrong statements, slopes."""


def terrain_scene(kind: str, seed: int) -> Terrain:
    """A terrain of a kind of `KINDS` or `HARD`; the same seed gives the same terrain."""
    site = Site(kind, seed)
    {**KINDS, **HARD}[kind](site)
    return site.terrain()


def stated(scene: Terrain, seed: int) -> tuple[Floats, float]:
    """Up and the sensor's height as a robot knows them: off by the errors of the scene."""
    random = np.random.default_rng([seed, 13])
    signs = random.choice([-1.0, 1.0], 4)
    wrong = Rotation.from_euler('xyz', scene.errors[0] * signs[:3], degrees=True)
    up: Floats = wrong.apply(scene.up)
    height = scene.pose.position[2] - scene.wave_height(np.zeros(3))
    return up, float(height + scene.errors[1] * signs[3])
