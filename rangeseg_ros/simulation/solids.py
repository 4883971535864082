"""Convex solids and exact ray casting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.runtime.threads import run_rows


@dataclass(frozen=True, eq=False)
class Solid:
    """Points p = (x, y, z, 1) with flat @ p <= 0 and, when there is a quadric, p'Qp <= 0.

    Attributes
    ----------
    flat : (K, 4) float64
        Outward unit normals and offsets (metres) of the planar faces.
    quadric : (4, 4) float64 or None
        Symmetric matrix of a convex quadric; the solid's last face.
    """

    flat: NDArray[np.float64]
    quadric: NDArray[np.float64] | None = None

    @property
    def planes(self) -> NDArray[np.float64]:
        """(F, 4) plane equations (normal, offset) of all faces; NaN for the curved one."""
        curved = self.quadric is not None
        return np.vstack([self.flat, np.full((int(curved), 4), np.nan)])

    def transformed(self, back: NDArray[np.float64]) -> Solid:
        """The solid whose points the matrix `back` (4, 4) takes to points of this one."""
        quadric = None if self.quadric is None else back.T @ self.quadric @ back
        return Solid(self.flat @ back, quadric)


def cast(
    solids: Sequence[Solid], origins: ArrayLike, directions: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """First hit of every ray, of one origin (3,) or one for each (..., 3).

    Returns its distance (...) in lengths of the direction (..., 3), inf where nothing is hit, and
    the number (...) of the face, counted through all solids; -1 for none.
    """
    directions = np.asarray(directions, np.float64)
    shape = directions.shape[:-1]
    directions = np.ascontiguousarray(directions.reshape(-1, 3))
    origins = np.ascontiguousarray(np.asarray(origins, np.float64).reshape(-1, 3))
    distance = np.full(len(directions), np.inf)
    face = np.full(len(directions), -1, np.int32)
    first = 0
    for solid in solids:
        quadric = _NONE if solid.quadric is None else solid.quadric
        run_rows(
            _enter,
            len(directions),
            origins,
            directions,
            solid.flat,
            quadric,
            first,
            distance,
            face,
        )
        first += len(solid.planes)
    return distance.reshape(shape), face.reshape(shape)


_NONE = np.zeros((0, 0))


@njit(cache=True, nogil=True)
def _enter(
    start: int,
    after: int,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    flat: NDArray[np.float64],
    quadric: NDArray[np.float64],
    first: int,
    distance: NDArray[np.float64],
    face: NDArray[np.int32],
) -> None:
    """Where rays start...after enter a solid, if that is nearer than `distance`, which is set.

    A ray is inside between its last entry into a half space (or the quadric) and its first exit.
    """
    for i in range(start, after):
        x, y, z = origins[i if len(origins) > 1 else 0]
        u, v, w = directions[i]
        entry, exit_, entered = -np.inf, distance[i], -1
        for k in range(len(flat)):
            rate = flat[k, 0] * u + flat[k, 1] * v + flat[k, 2] * w
            height = flat[k, 0] * x + flat[k, 1] * y + flat[k, 2] * z + flat[k, 3]
            if rate < 0:
                if -height / rate > entry:
                    entry, entered = -height / rate, k
            elif rate > 0:
                exit_ = min(exit_, -height / rate)
            elif height > 0:
                exit_ = -np.inf
            if entry >= exit_:
                break
        if len(quadric) and entry < exit_:
            inside, outside = _quadric_interval(quadric, x, y, z, u, v, w)
            if inside > entry:
                entry, entered = inside, len(flat)
            exit_ = min(exit_, outside)
        if 0 < entry < exit_:
            distance[i] = entry
            face[i] = first + entered


@njit(cache=True)
def _quadric_interval(
    quadric: NDArray[np.float64], x: float, y: float, z: float, u: float, v: float, w: float
) -> tuple[float, float]:
    """Ray parameters between which p'Qp <= 0; (inf, -inf) where that is nowhere."""
    a = b = 0.0
    c = quadric[3, 3]
    for i in range(3):
        origin, direction = (x, y, z)[i], (u, v, w)[i]
        gradient = quadric[i, 0] * x + quadric[i, 1] * y + quadric[i, 2] * z + quadric[i, 3]
        bend = quadric[i, 0] * u + quadric[i, 1] * v + quadric[i, 2] * w
        a += direction * bend
        b += direction * gradient
        c += origin * (gradient + quadric[i, 3])
    if a < 1e-15:  # along a cylinder's axis: inside or not, but never across
        return (-np.inf, np.inf) if c <= 0 else (np.inf, -np.inf)
    if b * b < a * c:
        return np.inf, -np.inf
    root = np.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


def half_space(normal: ArrayLike, point: ArrayLike) -> Solid:
    """Everything behind the plane through `point` whose outward normal is `normal`."""
    unit = np.asarray(normal, np.float64)
    unit = unit / np.linalg.norm(unit)
    return Solid(np.append(unit, -unit @ np.asarray(point, np.float64))[None])


def prism(outline: ArrayLike, height: float, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Right prism over a convex polygon, moved by `rotation` (3, 3) and then by `centre` (3,).

    `outline` (M, 2) are the corners of its base, counter-clockwise, metres; its own z runs from
    -height / 2 to height / 2.
    """
    corners = np.asarray(outline, np.float64)
    edges = np.roll(corners, -1, axis=0) - corners
    sides = np.column_stack([edges[:, 1], -edges[:, 0], np.zeros(len(edges))])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    upright = np.column_stack([sides, -(sides[:, :2] * corners).sum(axis=1)])
    return _placed(Solid(np.vstack([upright, _ends(height)])), rotation, centre)


def box(size: ArrayLike, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Box of a size (3,) in metres, rotated (world-from-box) and centred at `centre`."""
    x, y, z = np.asarray(size, np.float64) / 2
    return prism([(-x, -y), (x, -y), (x, y), (-x, y)], 2 * z, rotation, centre)


def sphere(radius: float, centre: ArrayLike) -> Solid:
    """Ball of a radius in metres."""
    quadric = np.diag([1.0, 1.0, 1.0, -(radius**2)])
    return _placed(Solid(np.zeros((0, 4)), quadric), np.eye(3), centre)


def cylinder(radius: float, height: float, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Cylinder along its own z axis, with flat ends."""
    quadric = np.diag([1.0, 1.0, 0.0, -(radius**2)])
    return _placed(Solid(_ends(height), quadric), rotation, centre)


def about_z(degrees: float) -> NDArray[np.float64]:
    """Rotation about the vertical."""
    rotation: NDArray[np.float64] = Rotation.from_euler('z', degrees, degrees=True).as_matrix()
    return rotation


def _ends(height: float) -> NDArray[np.float64]:
    """Top and bottom of a solid of that height about its origin."""
    return np.array([[0, 0, 1, -height / 2], [0, 0, -1, -height / 2]])


def _placed(solid: Solid, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Return the solid after p -> rotation @ p + centre."""
    back = np.eye(4)
    back[:3, :3] = np.asarray(rotation, np.float64).T
    back[:3, 3] = -back[:3, :3] @ np.asarray(centre, np.float64)
    return solid.transformed(back)
