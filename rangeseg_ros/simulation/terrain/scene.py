"""What a terrain is made of.

World frame: x ahead, y to the left, z up, metres; the robot stands at the origin on z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.solids import Solid, prism

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
        Of `KINDS` or `HARD`.
    pieces : tuple of Piece
    ground : tuple of Solid
        The ground continued, without holes and edges.
    pose : Pose
    waves : tuple of Wave
        Added to the ground.
    stairs : dict
        `direction`, `count`, `rise`, `run` of a staircase; empty without one.
    errors : (float, float)
        Of what the robot is told: degrees of up about each axis, metres of the height.
    relief : float
        Standard deviation of the height of rough ground, metres.
    """

    kind: str
    pieces: tuple[Piece, ...]
    ground: tuple[Solid, ...]
    pose: Pose
    waves: tuple[Wave, ...] = ()
    stairs: dict[str, float | str] = field(default_factory=dict)
    errors: tuple[float, float] = (1.0, 0.01)
    relief: float = 0.0

    @property
    def up(self) -> NDArray[np.float64]:
        """Up in the optical frame."""
        return self.pose.rotation[2]


def slab(start: float, end: float, low: float, high: float, y: tuple[float, float]) -> Solid:
    """Ground from x = start to end, rising from z = low to high, 3 m deep, between two y."""
    bottom = min(low, high) - 3.0
    outline = np.array([(start, bottom), (end, bottom), (end, high), (start, low)])
    # The prism's own x, y, z are the world's x, z, -y.
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return prism(outline, y[1] - y[0], rotation, (0, (y[0] + y[1]) / 2, 0))
