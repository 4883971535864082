"""Terrains on which ground and danger are easily confused: hidden edges, wrong statements, slopes.

World frame: x ahead, y to the left, z up, metres; the robot stands at the origin on z = 0.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.ground.classes import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.simulation.solids import box
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, WIDE, slab
from rangeseg_ros.simulation.terrain.site import Site

# Tangent of the lowest ray that a sensor of 58 degrees sees when it looks down by up to 20.
_BLIND = 1.15


def _landing(site: Site, step: float) -> None:
    """A level landing behind an edge that is nearer than the view begins."""
    site.height = float(site.random.choice([0.3, 0.5, 0.8, 1.2]))
    site.pitch, site.roll = site.random.uniform(0, 20), site.random.uniform(-3, 3)
    edge = site.random.uniform(0.2, 0.9) * site.height / _BLIND
    site.floor(end=edge)
    site.continued(edge)
    kind = OBSTACLE if step > 0 else DROP
    site.piece(slab(edge, FAR, step, step, ALL), kind, abs(step))


def _hidden_drop(site: Site) -> None:
    _landing(site, -float(site.random.choice([0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.3])))


def _hidden_kerb(site: Site) -> None:
    _landing(site, float(site.random.choice([0.05, 0.06, 0.08, 0.1, 0.12])))


def _edge(site: Site, distance: float, depth: float) -> None:
    """Floor that ends all across the way."""
    site.floor(end=distance)
    site.continued(distance)
    site.piece(slab(distance, FAR, -depth, -depth, ALL), DROP, depth)


def _strip(site: Site) -> None:
    """The edge a few centimetres inside the view."""
    site.height, site.pitch, site.roll = 0.8, site.random.uniform(26, 30), 0.0
    near = site.height / np.tan(np.radians(site.pitch + 21))
    depth = float(site.random.choice([0.06, 0.08, 0.1]))
    _edge(site, near + site.random.uniform(0.03, 0.15), depth)


def _wrong_height(site: Site) -> None:
    """The stated height is 5 to 15 cm off."""
    site.errors = 1.0, float(site.random.choice([0.05, 0.1, 0.15]))
    site.height, site.pitch = 0.8, 28.0
    _edge(site, site.random.uniform(1.2, 1.6), float(site.random.choice([0.08, 0.12, 0.17])))


def _wrong_up(site: Site) -> None:
    """The stated up is 3 to 5 degrees off about every axis."""
    site.errors = site.random.uniform(2, 3), 0.01
    _edge(site, site.ahead(), float(site.random.choice([0.06, 0.1, 0.2])))


def _slope(site: Site) -> None:
    """Ground that falls to the side, or rises or falls ahead, at 18 to 45 degrees."""
    angle = np.radians(site.random.choice([18, 20, 25, 30, 45]))
    if site.random.random() < 0.5:
        side, sign = site.random.uniform(0.1, 0.5), site.random.choice([-1, 1])
        site.piece(slab(-3, FAR, 0, 0, (-side, WIDE) if sign > 0 else (-WIDE, side)), GROUND, 0.0)
        site.continued(-3)
        turn = Rotation.from_euler('x', sign * angle).as_matrix()
        middle = np.array([0, -sign * side, 0]) + turn @ (FAR / 2 - 1.5, -sign * WIDE / 2, -1.5)
        site.piece(box((FAR + 3, WIDE, 3), turn, middle), DROP, 1.0)
        return
    foot, length = site.ahead(), site.random.uniform(0.8, 2)
    up = site.random.random() < 0.5
    top = length * np.tan(angle) * (1 if up else -1)
    site.floor(end=foot)
    site.continued(foot)
    kind = OBSTACLE if up else DROP
    site.piece(slab(foot, foot + length, 0, top, ALL), kind, abs(top))
    site.piece(slab(foot + length, FAR, top, top, ALL), kind, abs(top))


def _rough(site: Site) -> None:
    """Relief of 2 or 3 cm, and a hole or a kerb."""
    site.relief = float(site.random.choice([0.02, 0.03]))
    start = site.ahead(0.3, 1.0)
    if site.random.random() < 0.5:
        _edge(site, start, site.random.uniform(0.15, 0.4))
    else:
        site.floor()
        height = site.random.uniform(0.15, 0.4)
        site.piece(slab(start, start + 0.5, height, height, (-0.4, 0.4)), OBSTACLE, height)


def _gap(site: Site) -> None:
    """A gap of 5 to 30 cm all across; what is behind it is not judged."""
    start, width = site.ahead(), float(site.random.choice([0.05, 0.1, 0.15, 0.2, 0.3]))
    site.floor(end=start)
    site.continued(start, start + width)
    site.piece(slab(start, start + width, -1, -1, ALL), DROP, 1.0)
    site.ground.append(slab(start + width, FAR, 0, 0, ALL))
    site.piece(site.ground[-1], UNKNOWN, 0.0)


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
        site.piece(slab(edge, FAR, -6 * rise, -6 * rise, ALL), DROP, 6 * rise)


def _bridge(site: Site) -> None:
    """Ground 0.6 to 1.2 m wide with drops beside it."""
    side, depth = site.random.uniform(0.3, 0.6), float(site.random.choice([0.06, 0.1, 0.3, 1.0]))
    site.piece(slab(-3, FAR, 0, 0, (-side, side)), GROUND, 0.0)
    site.continued(-3)
    for across in ((-WIDE, -side), (side, WIDE)):
        site.piece(slab(-3, FAR, -depth, -depth, across), DROP, depth)


def _rolled(site: Site) -> None:
    """A camera mounted on its side before an edge."""
    site.roll = float(site.random.choice([-90, 90])) + site.random.uniform(-3, 3)
    site.pitch = site.random.uniform(20, 40)
    near = site.height / np.tan(np.radians(site.pitch + 25))
    _edge(site, near + site.random.uniform(0.3, 1), float(site.random.choice([0.06, 0.1, 0.3])))


HARD: dict[str, Callable[[Site], None]] = {
    'hidden drop': _hidden_drop,
    'hidden kerb': _hidden_kerb,
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
"""What is easily confused, by kind."""
