"""Planes made level, plumb and square, where their covariances allow it.

A constraint that a plane keeps within its errors (chi-squared, 0.999) is imposed on it as an exact
observation: the most likely plane that keeps it. So a plane turns about where it is known best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.map_outlines import MapOutline
from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.core.significance import chi2_quantile

_ROUNDS = 3  # until the azimuth of a group settles


class Squared(NamedTuple):
    """A plane and what was made exact of it.

    Attributes
    ----------
    plane : MapPlane
    group : int
        Number of the walls that it is parallel or at right angles to, 1...; 0 for none.
    exact : str
        'level', 'plumb', 'square' (plumb, and of a group), or ''.
    turned : float
        Angle by which it was turned, radians.
    """

    plane: MapPlane
    group: int
    exact: str
    turned: float


def square_up(planes: Sequence[MapPlane], tolerance: float) -> list[Squared]:
    """Make planes level or plumb, and walls parallel or at right angles to each other.

    Parameters
    ----------
    planes : sequence of MapPlane
        In a frame whose z is up.
    tolerance : float
        Largest angle to the horizontal or vertical of a plane that may be meant so, radians.

    Returns
    -------
    list of Squared
        In the order of the planes. Outlines are moved onto their planes.
    """
    equations = [np.append(plane.normal, plane.distance) for plane in planes]
    covariances = [plane.covariance for plane in planes]
    exact = [''] * len(planes)
    for k, plane in enumerate(planes):
        level = abs(plane.normal[2]) > np.cos(tolerance)
        if level or abs(plane.normal[2]) < np.sin(tolerance):
            rows = np.eye(4)[:2] if level else np.eye(4)[2:3]
            done = _imposed(equations[k], covariances[k], rows, -rows @ equations[k])
            if done is not None:
                equations[k], covariances[k] = done
                exact[k] = 'level' if level else 'plumb'
    group = [0] * len(planes)
    plumb = [k for k, kind in enumerate(exact) if kind == 'plumb']
    for number, (azimuth, members) in enumerate(_groups(planes, equations, covariances, plumb), 1):
        for k in members:
            row, gap = _to_azimuth(equations[k], azimuth)
            done = _imposed(equations[k], covariances[k], row, gap)
            if done is not None:
                equations[k], covariances[k] = _at_azimuth(*done, plane=planes[k], azimuth=azimuth)
                exact[k], group[k] = 'square', number
    found = []
    for k, plane in enumerate(planes):
        cosine = np.clip(plane.normal @ equations[k][:3], -1, 1)
        moved = _moved(plane, equations[k], covariances[k]) if exact[k] else plane
        found.append(Squared(moved, group[k], exact[k], float(np.arccos(cosine))))
    return found


def _groups(
    planes: Sequence[MapPlane],
    equations: list[NDArray[np.float64]],
    covariances: list[NDArray[np.float64]],
    plumb: list[int],
) -> list[tuple[float, list[int]]]:
    """Azimuths, modulo a right angle, that two walls or more share, those of large ones first."""
    rest = sorted(plumb, key=lambda k: -planes[k].area)
    angle = {k: np.arctan2(equations[k][1], equations[k][0]) for k in rest}
    variance = {}
    for k in rest:
        row, _ = _to_azimuth(equations[k], 0.0)
        variance[k] = float((row @ covariances[k] @ row.T)[0, 0])
    found = []
    while rest:
        azimuth, spread, members = angle[rest[0]], variance[rest[0]], [rest[0]]
        for _ in range(_ROUNDS):
            gap = {k: _modulo(angle[k] - azimuth) for k in rest}
            # The seed is a member: its own error is that of the azimuth at first.
            members = [k for k in rest if gap[k] ** 2 < chi2_quantile(1) * (variance[k] + spread)]
            weight = np.array([1 / max(variance[k], 1e-12) for k in members])
            azimuth += float(weight @ [gap[k] for k in members] / weight.sum())
            spread = 1 / weight.sum()
        if len(members) > 1:
            found.append((azimuth, members))
        rest = [k for k in rest if k not in members and k != rest[0]]
    return found


def _to_azimuth(
    equation: NDArray[np.float64], azimuth: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivative (1, 4) of a normal's azimuth, and what is missing to `azimuth` mod 90 degrees."""
    x, y = equation[:2]
    row = np.array([[-y, x, 0, 0]]) / (x * x + y * y)
    return row, np.array([-_modulo(np.arctan2(y, x) - azimuth)])


def _at_azimuth(
    equation: NDArray[np.float64],
    covariance: NDArray[np.float64],
    plane: MapPlane,
    azimuth: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A plumb plane at an azimuth, mod 90 degrees, without what the first order has left."""
    azimuth = np.arctan2(equation[1], equation[0]) - _modulo(
        np.arctan2(equation[1], equation[0]) - azimuth
    )
    normal = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    distance = (equation[:3] - normal) @ plane.centroid + equation[3]
    return np.append(normal, distance), covariance


def _modulo(angle: float) -> float:
    """An angle to the nearest multiple of a right angle."""
    return float(angle - np.pi / 2 * np.round(angle / (np.pi / 2)))


def _imposed(
    equation: NDArray[np.float64],
    covariance: NDArray[np.float64],
    rows: NDArray[np.float64],
    gap: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """A plane and its covariance once `rows` of it have changed by `gap`; None when too far."""
    spread = rows @ covariance @ rows.T
    if gap @ np.linalg.pinv(spread) @ gap > chi2_quantile(len(rows)):
        return None
    gain = covariance @ rows.T @ np.linalg.pinv(spread)
    changed = equation + gain @ gap
    return changed / np.linalg.norm(changed[:3]), covariance - gain @ rows @ covariance


def _moved(
    plane: MapPlane, equation: NDArray[np.float64], covariance: NDArray[np.float64]
) -> MapPlane:
    """A plane with another equation, its outline on it."""
    normal, distance = equation[:3], float(equation[3])

    def onto(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return points - (points @ normal + distance)[..., None] * normal

    return replace(
        plane,
        normal=normal,
        distance=distance,
        covariance=covariance,
        centroid=onto(plane.centroid),
        outline=MapOutline([[onto(ring) for ring in part] for part in plane.outline.parts]),
    )
