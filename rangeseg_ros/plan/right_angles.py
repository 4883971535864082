"""Planes made level, plumb and square, where their covariances allow it.

A constraint that planes keep within their errors (chi-squared, 0.999) is imposed on all planes
together as an exact observation: they become the most likely planes that keep it. So a plane turns
about where it is known best, and two that become parallel share what they turn by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.mapping.map_planes import MapPlane, moved_onto
from rangeseg_ros.core.significance import chi2_quantile


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Squared(MapPlane):
    """A plane and what was made exact of it.

    `exact` is 'level', 'plumb', 'square' (plumb, and of the walls of a `group`, 1..., that are
    parallel or at right angles), or ''; `turned` is the angle it was turned by, radians.
    """

    group: int
    exact: str
    turned: float

    @property
    def drawn(self) -> bool:
        """Whether plans show its area: it leans by less than 60 degrees, and is no ceiling."""
        return abs(float(self.normal[2])) > 0.5 and self.role != 'ceiling'


def square_up(planes: Sequence[MapPlane], covariance: Floats, tolerance: float) -> list[Squared]:
    """Make planes level or plumb, and walls parallel or at right angles to each other.

    The P planes are in a frame whose z is up, with the covariance (4 P, 4 P) of the normals and
    distances of all of them; they stay in order, their outlines moved onto them. Planes within
    `tolerance`, radians, of the horizontal or vertical may be meant so.
    """
    known = _Conditions(planes, covariance)
    exact, group = [''] * len(planes), [0] * len(planes)
    for k, plane in enumerate(planes):
        level = abs(plane.normal[2]) > np.cos(tolerance)
        axes = [0, 1] if level else [2] if abs(plane.normal[2]) < np.sin(tolerance) else []
        rows = np.eye(4 * len(planes))[4 * k + np.array(axes, np.intp)]
        if axes and known.impose(rows, -rows @ known.values):
            exact[k] = 'level' if level else 'plumb'
    seeds: dict[int, int] = {}
    order = np.argsort([-plane.area for plane in planes], kind='stable').tolist()
    rest = [k for k in order if exact[k] == 'plumb']
    while rest:
        seed, *others = rest
        members = [seed, *(k for k in others if known.impose(*known.out_of_square(k, seed)))]
        rest = [k for k in others if k not in members]
        if len(members) > 1:
            number = len(set(seeds.values())) + 1
            for k in members:
                exact[k], group[k], seeds[k] = 'square', number, seed
    equations = known.values.reshape(-1, 4).copy()
    for k, plane in enumerate(planes):
        if exact[k]:
            # Set the normal exactly: the update was linear.
            normal = _exact(exact[k], equations[k], equations[seeds.get(k, k)])
            equations[k, 3] += (equations[k, :3] - normal) @ plane.centroid
            equations[k, :3] = normal
    found = []
    for k, moved in enumerate(moved_onto(planes, equations, known.covariance)):
        turned = float(np.arccos(np.clip(planes[k].normal @ moved.normal, -1, 1)))
        found.append(Squared(**vars(moved), group=group[k], exact=exact[k], turned=turned))
    return found


class _Conditions:
    """Planes under the conditions that were imposed on them: `values` (4 P,), `covariance`."""

    def __init__(self, planes: Sequence[MapPlane], covariance: Floats) -> None:
        self.values = np.array([[*plane.normal, plane.distance] for plane in planes]).ravel()
        self.covariance = covariance

    def impose(self, rows: Floats, gap: Floats) -> bool:
        """Have `rows` of the values change by `gap`, unless that is too far."""
        inverse = np.linalg.pinv(rows @ self.covariance @ rows.T)
        if gap @ inverse @ gap > chi2_quantile(len(gap)):
            return False
        gain = self.covariance @ rows.T @ inverse
        self.values = self.values + gain @ gap
        self.covariance = self.covariance - gain @ rows @ self.covariance
        return True

    def out_of_square(self, k: int, m: int) -> tuple[Floats, Floats]:
        """Derivative (1, 4 P) of the difference of two azimuths, and its gap to square (1,)."""
        row, azimuth = np.zeros((1, len(self.values))), []
        for sign, plane in ((1, k), (-1, m)):
            x, y = self.values[4 * plane : 4 * plane + 2]
            row[0, 4 * plane : 4 * plane + 2] += sign * np.array([-y, x]) / (x * x + y * y)
            azimuth.append(np.arctan2(y, x))
        return row, np.array([-_modulo(azimuth[0] - azimuth[1])])


def _modulo(angle: float) -> float:
    """An angle to the nearest multiple of a right angle."""
    return float(angle - np.pi / 2 * np.round(angle / (np.pi / 2)))


def _exact(kind: str, own: Floats, seed: Floats) -> Floats:
    """A normal that is level, plumb, or square to that of the seed."""
    if kind == 'level':
        return np.array([0.0, 0.0, np.sign(own[2])])
    azimuth, wanted = np.arctan2(own[1], own[0]), np.arctan2(seed[1], seed[0])
    azimuth -= _modulo(azimuth - wanted)
    return np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
