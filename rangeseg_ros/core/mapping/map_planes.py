"""Planes of a map: what is kept of each beside its equation, and what is told of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.description.shapes import Shape
from rangeseg_ros.core.mapping.evidence import HIT, LEAST, MISS, Evidence
from rangeseg_ros.core.mapping.map_outlines import MapOutline, rectangle, rings
from rangeseg_ros.core.rotations import quaternions


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MapPlane(Plane):
    """A plane of the map; normal . p + distance = 0 in the fixed frame.

    All that `Plane` tells is of the fixed frame; the normal points to the side that the plane was
    seen from. `extents`, `centre` and `orientation` are those of the least rectangle around all
    parts, `count` is the number of pixels of all observations, `rms` and `confidence` are means
    over them, `probability` is the largest, and `role` is what most observations found.

    Attributes
    ----------
    observations : int
        Number of regions that were fused.
    age : float
        Seconds between the first and the last sight of it.
    first_stamp, last_stamp : int
        Of these, nanoseconds.
    """

    outline: MapOutline  # type: ignore[assignment]
    observations: int
    age: float
    first_stamp: int
    last_stamp: int


@dataclass(eq=False)
class Record:
    """What is kept of a plane beside its equation.

    `first` and `last` are stamps; `seen` and `united` are of the map's own time, which goes on
    where stamps do not: when it was seen last, and when its outline was looked at last.
    `surface` is that of the frame that saw it last. `margin` is the outline and what is so near
    that it is no detail of the map, once that was asked for. `evidence` is of the outline where
    `followed`.
    """

    id: int
    first: int
    last: int
    observations: int = 0
    pixels: int = 0
    squares: float = 0.0
    confidence: float = 0.0
    probability: float = 0.0
    roles: Counter[str] = field(default_factory=Counter)
    outline: shapely.Geometry = field(default_factory=shapely.Polygon)
    margin: shapely.Geometry | None = None
    seen: int = 0
    surface: int = 0
    united: int = 0
    frames: int = 0
    looks: int = 0
    evidence: Evidence = field(default_factory=Evidence)
    followed: bool = False

    @property
    def confirmed(self) -> bool:
        """Whether it was seen often enough to be part of the map.

        It is to be as surely there as what is forgotten is not, by the frames it was found in and
        those in which rays ended where it is and it was not: clutter looks like planes now and
        then.
        """
        missed = max(self.looks - self.frames, 0)
        return HIT * self.frames + MISS * missed >= -LEAST

    def add(self, plane: Plane, stamp: int, now: int) -> None:
        """Take in a plane of a frame."""
        self.frames += now > self.seen
        self.last, self.seen, self.surface = stamp, now, plane.surface
        self.observations += 1
        self.pixels += plane.count
        self.squares += plane.count * plane.rms**2
        self.confidence += plane.count * plane.confidence
        self.probability = max(self.probability, plane.probability)
        self.roles[plane.role] += 1

    def reshape(self, outline: shapely.Geometry, margin: shapely.Geometry | None = None) -> None:
        """Have another outline."""
        self.outline, self.margin, self.followed = outline, margin, False

    def absorb(self, other: Record) -> None:
        """Take in what is kept of a plane that turned out to be this one."""
        self.id = min(self.id, other.id)
        self.first, self.last = min(self.first, other.first), max(self.last, other.last)
        self.seen = max(self.seen, other.seen)
        self.observations += other.observations
        self.frames, self.looks = max(self.frames, other.frames), max(self.looks, other.looks)
        self.pixels += other.pixels
        self.squares += other.squares
        self.confidence += other.confidence
        self.probability = max(self.probability, other.probability)
        self.roles += other.roles


def describe(
    record: Record,
    normal: NDArray[np.float64],
    point: NDArray[np.float64],
    axes: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> MapPlane:
    """The plane of a record.

    Parameters
    ----------
    record : Record
    normal, point : (3,) float64
        In the fixed frame.
    axes : (2, 3) float64
        Those of the outline.
    covariance : (4, 4) float64
        Of normal and distance.
    """
    centre, sides, extents = rectangle(record.outline)
    frame = np.stack([*(sides @ axes), normal], axis=1)
    outline = MapOutline(
        [[point + ring @ axes for ring in part] for part in rings(record.outline)]
    )
    return MapPlane(
        label=record.id,
        id=record.id,
        surface=record.id,
        normal=normal.copy(),
        distance=float(-normal @ point),
        covariance=covariance,
        centroid=point + shapely.get_coordinates(record.outline.centroid)[0] @ axes,
        count=record.pixels,
        rms=float(np.sqrt(record.squares / record.pixels)),
        confidence=record.confidence / record.pixels,
        probability=record.probability,
        shape=Shape(
            area=record.outline.area,
            extents=extents,
            centre=point + centre @ axes,
            orientation=quaternions(frame),
        ),
        outline=outline,
        role=record.roles.most_common(1)[0][0],
        observations=record.observations,
        age=(record.last - record.first) * 1e-9,
        first_stamp=record.first,
        last_stamp=record.last,
    )
