"""Test pieces: one object of a known size at a known distance on level ground, or none of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.cells import DROP, OBSTACLE
from rangeseg_ros.simulation.solids import box, cylinder
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, Site, Terrain, slab

SIZES = (0.05, 0.1, 0.2, 0.3)
"""Heights of cylinders, boxes and kerbs, depths of edges, widths of gaps, metres."""
SLOPES = (5.0, 10.0, 15.0, 20.0)
"""Of ramps, degrees."""
DISTANCES = (1.0, 2.0, 3.0)
"""Metres ahead of the camera."""


def _cylinder(site: Site, ahead: float, size: float) -> None:
    """5 cm thick."""
    site.floor()
    place = ahead, site.random.uniform(-0.3, 0.3), size / 2
    site.piece(cylinder(0.025, size, np.eye(3), place), OBSTACLE, size)


def _box(site: Site, ahead: float, size: float) -> None:
    """A cube."""
    site.floor()
    place = ahead + size / 2, site.random.uniform(-0.3, 0.3), size / 2
    site.piece(box((size, size, size), np.eye(3), place), OBSTACLE, size)


def _kerb(site: Site, ahead: float, size: float) -> None:
    site.floor()
    site.off_level(ahead, FAR, size, size)


def _gap(site: Site, ahead: float, size: float) -> None:
    """Its far side belongs to it."""
    site.gap(ahead, size)
    site.piece(slab(ahead + size - 0.01, ahead + size, -0.002, -0.002, ALL), DROP, 1.0)


def _ramp(site: Site, ahead: float, slope: float) -> None:
    """1 m long, up; an obstacle where it is steeper than ground may be."""
    top = float(np.tan(np.radians(slope)))
    if slope > Config().ground_slope:
        site.slope(ahead, 1, top)
    else:
        site.floor(end=ahead)
        site.floor(ahead, ahead + 1, 0, top)
        site.floor(ahead + 1, FAR, top, top)


PIECES: dict[str, Callable[[Site, float, float], None]] = {
    'cylinder': _cylinder,
    'box': _box,
    'kerb': _kerb,
    'edge': lambda site, ahead, size: site.step(ahead, -size),
    'gap': _gap,
    'ramp': _ramp,
}
"""Kinds of test pieces."""


def catalogue() -> Iterator[tuple[str, float, float]]:
    """Kind, size (metres, of ramps degrees) and distance (metres) of every test piece."""
    for kind in PIECES:
        for size in SLOPES if kind == 'ramp' else SIZES:
            for distance in DISTANCES:
                yield kind, size, distance


def piece_scene(
    kind: str, size: float, distance: float, mount: float, seed: int, random: Any = None
) -> Terrain:
    """A test piece, seen from `mount` metres above the ground by a camera aimed 1.5 m ahead.

    Place across the view, direction and errors of what is stated follow from `seed` or, where it
    is given, from `random`, of which `uniform` is called.
    The `kind` of the scene is that of the piece with its size and distance.
    """
    site = Site(f'{kind} {size:g} {distance:g}', seed)
    site.random = random or site.random
    site.height, site.roll = mount, site.random.uniform(-2, 2)
    site.pitch = float(np.degrees(np.arctan2(mount, 1.5))) + site.random.uniform(-3, 3)
    PIECES[kind](site, distance + site.random.uniform(-0.1, 0.1), size)
    return site.terrain()
