"""Outlines of planes that grow with every look: unions of polygons on the plane."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

# Corners that an outline may have: what is more is rounded off, so that memory is bounded.
_CORNERS = 400


@dataclass(frozen=True, eq=False)
class MapOutline:
    """Parts of a plane that were seen, in the fixed frame.

    Attributes
    ----------
    parts : list of list of (N, 3) float64
        For each part, largest first, its border, counter-clockwise seen from where the
        plane was seen, and the borders of its holes, clockwise.
    """

    parts: list[list[NDArray[np.float64]]]

    @property
    def hull(self) -> NDArray[np.float64]:
        """(N, 3) border of the largest part, metres."""
        return self.parts[0][0] if self.parts else np.zeros((0, 3))

    @property
    def holes(self) -> list[NDArray[np.float64]]:
        """Borders (N, 3) of the holes in the largest part."""
        return self.parts[0][1:] if self.parts else []


def polygon_of(
    hull: NDArray[np.float64], holes: Iterable[NDArray[np.float64]]
) -> Polygon | MultiPolygon:
    """Polygon of rings (N, 2); empty when they enclose nothing."""
    if len(hull) < 3:
        return Polygon()
    return valid(Polygon(hull, [hole for hole in holes if len(hole) > 2]))


def valid(shape: shapely.Geometry) -> Polygon | MultiPolygon:
    """A geometry whose borders do not cross themselves, the only kind that unions take."""
    return shape if shape.is_valid else areas(shapely.make_valid(shape))


def areas(shape: shapely.Geometry) -> Polygon | MultiPolygon:
    """The polygons among what a geometry is made of."""
    if isinstance(shape, Polygon | MultiPolygon):
        return shape
    parts = [part for part in shapely.get_parts(shape) if isinstance(part, Polygon)]
    return MultiPolygon(parts)


def widened(outline: shapely.Geometry, by: float) -> Polygon | MultiPolygon:
    """An outline and what is as near (metres); without its border where that is negative."""
    # Corners of narrow notches may cross (GEOS 3.14).
    return valid(shapely.buffer(outline, by, join_style='mitre'))


def unite_outlines(
    outline: Polygon | MultiPolygon, seen: Polygon | MultiPolygon, resolution: float
) -> tuple[Polygon | MultiPolygon, Polygon | MultiPolygon]:
    """Union of outlines without details smaller than `resolution` (metres).

    Gaps narrower than twice that are closed and smaller holes and parts left out, and the
    border is followed within a quarter of it; where it has many corners still, less closely.

    Parameters
    ----------
    outline, seen : shapely geometry
        The outline so far and what is added.
    resolution : float

    Returns
    -------
    shapely geometry
        The union.
    shapely geometry
        The same with what is nearer than `resolution`.
    """
    margin = widened(outline.union(seen), resolution)
    return simplify(widened(margin, -resolution), resolution), margin


def simplify(outline: shapely.Geometry, resolution: float) -> Polygon | MultiPolygon:
    """An outline without details smaller than `resolution`, of a bounded number of corners."""
    least = resolution**2
    while True:
        parts = shapely.get_parts(outline.simplify(resolution / 4))
        parts = parts[shapely.area(parts) >= least]
        parts = [_filled(part, least) for part in parts.tolist()]
        result = parts[0] if len(parts) == 1 else MultiPolygon(parts)
        if shapely.get_num_coordinates(result) <= _CORNERS:
            return result
        resolution, least = 2 * resolution, 4 * least


def _filled(part: Polygon, least: float) -> Polygon:
    """A polygon without its holes smaller than `least` (square metres)."""
    if not shapely.get_num_interior_rings(part):
        return part
    return Polygon(part.exterior, [r for r in part.interiors if Polygon(r).area >= least])


def rings(outline: Polygon | MultiPolygon) -> list[list[NDArray[np.float64]]]:
    """Rings (N, 2), not closed, of each part, largest first; borders counter-clockwise."""
    parts = sorted(shapely.get_parts(outline), key=lambda part: -part.area)
    result = []
    for part in parts:
        turned = shapely.geometry.polygon.orient(part)
        lines = turned.exterior, *turned.interiors
        result.append([np.asarray(ring.coords)[:-1] for ring in lines])
    return result


def rectangle(
    outline: Polygon | MultiPolygon,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Centre (2,), axes (2, 2) and extents (2,) of the least rectangle around an outline.

    The longer side comes first; the axes are right-handed.
    """
    corners = shapely.get_coordinates(outline.minimum_rotated_rectangle)[:4]
    sides = np.diff(corners[:3], axis=0)
    extents = np.linalg.norm(sides, axis=1)
    axis = sides[extents.argmax()] / extents.max()
    axes = np.stack([axis, [-axis[1], axis[0]]])
    return corners.mean(axis=0), axes, np.sort(extents)[::-1]
