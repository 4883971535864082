"""Where a plane of the map is still there: cells of its outline that rays end at or pass."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from rangeseg_ros.core.mapping.map_outlines import areas

HIT, MISS, _MOST, LEAST = 0.85, -0.4, 3.5, -2.0
"""Log-odds of a ray that ends at a cell and of one that passes through it, and the bounds of their
sum, so that a cell follows a change within ten looks: Hornung et al., "OctoMap", Autonomous
Robots 2013.
"""
# Cells of a plane at most; the side of a cell is a power of two.
_CELLS = 64


class Evidence:
    """Log-odds that a plane is there, in square cells of its outline.

    Attributes
    ----------
    centres : (K, 2) float64
        Of the cells, metres along the axes of the plane.
    odds : (K,) float64
    middle : (2,) float64
        Centre of a circle with all of the cells' centres.
    reach : float
        Its radius, metres.
    """

    def __init__(self) -> None:
        # Of an outline that was not followed yet, the one place where the plane was found first.
        self.centres = np.zeros((1, 2))
        self._side = 0.0
        self._keys = np.zeros(1, np.int64)
        self.odds = np.full(1, HIT)
        self.middle, self.reach = np.zeros(2), 0.0

    def follow(self, outline: Polygon | MultiPolygon) -> None:
        """Have the cells of an outline; what is new has just been seen."""
        side = 2.0 ** math.ceil(math.log2(math.sqrt(max(outline.area, 1e-4) / _CELLS)))
        if side != self._side:
            self._side, self._keys, self.odds = side, np.zeros(0, np.int64), np.zeros(0)
        left, low, right, high = outline.bounds if not outline.is_empty else (0, 0, -1, -1)
        column = np.arange(math.floor(left / side), math.floor(right / side) + 2)
        row = np.arange(math.floor(low / side), math.floor(high / side) + 2)
        corner = shapely.contains_xy(outline, column[:, None] * side, row * side)
        # Borders are not as certain as what is within.
        whole = corner[:-1, :-1] & corner[1:, :-1] & corner[:-1, 1:] & corner[1:, 1:]
        across, along = np.nonzero(whole)
        cells = np.stack([column[across], row[along]], axis=1)
        if not len(cells) and not outline.is_empty:
            # A sliver between the corners of cells.
            point = outline.representative_point()
            cells = np.floor([[point.x / side, point.y / side]]).astype(np.int64)
        # In ascending order, as the cells are.
        keys = cells[:, 0] * 2**32 + cells[:, 1]
        odds = np.full(len(keys), HIT)
        if len(self._keys):
            place = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
            known = self._keys[place] == keys
            odds[known] = self.odds[place[known]]
        self._keys, self.odds = keys, odds
        self.centres = (cells + 0.5) * side
        if len(cells):
            least, most = self.centres.min(axis=0), self.centres.max(axis=0)
            self.middle, self.reach = (least + most) / 2, math.dist(least, most) / 2

    def remaining(self, outline: Polygon | MultiPolygon) -> Polygon | MultiPolygon:
        """What is left of an outline without the cells that rays pass through."""
        gone = self.odds < 0
        if gone.all():
            return Polygon()
        half = self._side / 2
        around = []
        for chosen, reach in ((~gone, 2 * half), (gone, half)):
            x, y = self.centres[chosen].T
            around.append(
                shapely.union_all(shapely.box(x - reach, y - reach, x + reach, y + reach))
            )
        return areas(outline.intersection(around[0]).difference(around[1]))


def see(
    evidence: Sequence[Evidence], owner: NDArray[np.intp], found: NDArray[np.int8]
) -> NDArray[np.intp]:
    """Take in `sightings` of the cells of planes, one plane after the other.

    Parameters
    ----------
    evidence : sequence of Evidence
        Of M planes.
    owner : (N,) int
        Number of the plane of each cell.
    found : (N,) int8
        Of the cells.

    Returns
    -------
    (K,) int
        Numbers of the planes with cells that rays pass through.
    """
    odds = np.concatenate([one.odds for one in evidence])
    odds += np.where(found > 0, HIT, np.where(found < 0, MISS, 0))
    np.clip(odds, LEAST, _MOST, out=odds)
    begin = 0
    for one in evidence:
        end = begin + len(one.odds)
        one.odds = odds[begin:end]
        begin = end
    return np.unique(owner[odds < 0])
