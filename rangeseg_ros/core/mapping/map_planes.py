"""Planes of a map: what is kept of each beside its equation, and what is told of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.description.shapes import Shape
from rangeseg_ros.core.mapping.observations import PlaneSet
from rangeseg_ros.core.mapping.plane_grid import PlaneGrid
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import turn_between
from rangeseg_ros.core.tracking.plane_errors import moved_plane

AnyPlane = TypeVar('AnyPlane', bound=Plane)


@dataclass(frozen=True, eq=False)
class MapOutline:
    """Parts of a plane that were seen, in the fixed frame, largest first.

    For each its border (N, 3), counter-clockwise seen from where the plane was seen, and the
    borders of its holes, clockwise.
    """

    parts: list[list[Floats]]

    @property
    def hull(self) -> Floats:
        """(N, 3) border of the largest part, metres."""
        return self.parts[0][0] if self.parts else np.zeros((0, 3))

    @property
    def holes(self) -> list[Floats]:
        """Borders (N, 3) of the holes in the largest part."""
        return self.parts[0][1:] if self.parts else []

    @property
    def rings(self) -> list[Floats]:
        """All borders (N, 3)."""
        return [ring for part in self.parts for ring in part]

    def moved(self, motion: Callable[[Floats], Floats]) -> MapOutline:
        """The outline with its corners (N, 3) moved."""
        return MapOutline([[motion(ring) for ring in part] for part in self.parts])


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MapPlane(Plane):
    """A plane of the map; normal . p + distance = 0 in the fixed frame.

    All that `Plane` tells is of the fixed frame; the normal points to the side that the plane was
    seen from. `extents`, `centre` and `orientation` are those of the least rectangle around all
    parts, `count` is the number of pixels of all observations, `rms` and `confidence` are means
    over them, `probability` is the largest, and `role` is what most observations found.
    `observations` is the number of regions that were fused, `age` the seconds from the first
    stamp, nanoseconds, to the last one.
    """

    outline: MapOutline  # type: ignore[assignment]
    observations: int
    age: float
    first_stamp: int
    last_stamp: int


@dataclass(eq=False)
class Record:
    """What is kept of a plane beside its equation.

    `first` and `last` are stamps; `seen` is of the map's own time, which goes on where stamps do
    not. `track` and `surface` are what the tracker called it in the frame that saw it last.
    """

    id: int
    first: int
    grid: PlaneGrid
    last: int = 0
    observations: int = 0
    pixels: int = 0
    squares: float = 0.0
    confidence: float = 0.0
    probability: float = 0.0
    roles: Counter[str] = field(default_factory=Counter)
    seen: int = 0
    track: int = 0
    surface: int = 0

    def add(self, plane: Plane, stamp: int, now: int) -> None:
        """Take in a plane of a frame."""
        self.last, self.seen = stamp, now
        self.track, self.surface = plane.id, plane.surface
        self.observations += 1
        self.pixels += plane.count
        self.squares += plane.count * plane.rms**2
        self.confidence += plane.count * plane.confidence
        self.probability = max(self.probability, plane.probability)
        self.roles[plane.role] += 1

    def absorb(self, other: Record) -> None:
        """Take in what is kept of a plane that turned out to be this one."""
        self.id = min(self.id, other.id)
        self.first, self.last = min(self.first, other.first), max(self.last, other.last)
        self.seen = max(self.seen, other.seen)
        self.probability = max(self.probability, other.probability)
        for name in ('observations', 'pixels', 'squares', 'confidence', 'roles'):
            setattr(self, name, getattr(self, name) + getattr(other, name))


def describe(record: Record, plane: PlaneSet, covariance: Floats) -> MapPlane:
    """The plane of a record: one of the fixed frame, with the axes of its grid.

    `covariance` (4, 4) is that of normal and distance.
    """
    grid, normal = record.grid, plane.normal[0]
    cells = grid.centres()
    middle, size, angle = cv2.minAreaRect(cells.astype(np.float32))
    along = np.radians(angle if size[0] >= size[1] else angle + 90)
    major = np.array([np.cos(along), np.sin(along)]) @ plane.axes[0]
    frame = np.stack([major, np.cross(normal, major), normal], axis=1)
    return MapPlane(
        label=record.id,
        id=record.id,
        surface=record.id,
        normal=normal.copy(),
        distance=float(plane.distance[0]),
        covariance=covariance,
        centroid=plane.points(cells.mean(axis=0)[None])[0],
        count=record.pixels,
        rms=float(np.sqrt(record.squares / record.pixels)),
        confidence=record.confidence / record.pixels,
        probability=record.probability,
        shape=Shape(
            area=grid.area,
            extents=np.sort(size)[::-1] + grid.side,
            centre=plane.points(np.array([middle]))[0],
            frame=frame,
        ),
        outline=MapOutline([list(part) for part in grid.polygons()]).moved(plane.points),
        role=record.roles.most_common(1)[0][0],
        observations=record.observations,
        age=(record.last - record.first) * 1e-9,
        first_stamp=record.first,
        last_stamp=record.last,
    )


def moved_planes(planes: Sequence[AnyPlane], motion: Transform) -> list[AnyPlane]:
    """Planes in the frame that `motion` leads to; normals stay on the side of the sensor."""
    turn, shift = motion
    jacobian = moved_plane(turn, shift)
    moved = []
    for plane in planes:
        normal = turn @ plane.normal
        shape = Shape(
            area=plane.area,
            extents=plane.extents,
            centre=turn @ plane.centre + shift,
            frame=turn @ plane.shape.frame,
        )
        outline = MapOutline(plane.outline.parts).moved(lambda ring: ring @ turn.T + shift)
        moved.append(
            replace(
                plane,
                normal=normal,
                distance=float(plane.distance - normal @ shift),
                covariance=jacobian @ plane.covariance @ jacobian.T,
                centroid=turn @ plane.centroid + shift,
                shape=shape,
                outline=outline,  # type: ignore[arg-type]
            )
        )
    return moved


def moved_onto(
    planes: Sequence[MapPlane], equations: Floats, covariance: Floats
) -> list[MapPlane]:
    """Planes turned about their centroids onto other equations (P, 4).

    `covariance` (4 P, 4 P) is that of all of these.
    """
    found = []
    for k, (plane, equation) in enumerate(zip(planes, equations, strict=True)):
        turn = turn_between(plane.normal, equation[:3])
        foot = plane.centroid - (equation @ [*plane.centroid, 1]) * equation[:3]
        (moved,) = moved_planes([plane], Transform(turn, foot - turn @ plane.centroid))
        own = np.s_[4 * k : 4 * k + 4]
        found.append(replace(moved, covariance=covariance[own, own]))
    return found
