"""Convex solids and exact ray casting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.runtime.threads import map_halves


@dataclass(frozen=True, eq=False)
class Solid:
    """Points p = (x, y, z, 1) with p'Qp <= 0 for the matrix Q of every face.

    Attributes
    ----------
    faces : (F, 4, 4) float64
        Symmetric matrices of planes, [[0, n / 2], [n / 2, d]] with the outward unit normal n and
        the offset d (metres), and of convex quadrics.
    """

    faces: Floats

    @property
    def planes(self) -> Floats:
        """(F, 4) plane equations (normal, offset) of the faces; NaN for curved ones."""
        planes = np.column_stack([2 * self.faces[:, 3, :3], self.faces[:, 3, 3]])
        planes[self.faces[:, :3, :3].any(axis=(1, 2))] = np.nan
        return planes

    def transformed(self, back: Floats) -> Solid:
        """The solid whose points the matrix `back` (4, 4) takes to points of this one."""
        return Solid(back.T @ self.faces @ back)


def cast(
    solids: Sequence[Solid], origins: ArrayLike, directions: ArrayLike
) -> tuple[Floats, NDArray[np.int32]]:
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
        given = origins, directions, solid.faces, first, distance, face
        map_halves(_enter, len(directions), *given)
        first += len(solid.faces)
    return distance.reshape(shape), face.reshape(shape)


@njit(cache=True, nogil=True)
def _enter(
    start: int,
    after: int,
    origins: Floats,
    directions: Floats,
    faces: Floats,
    first: int,
    distance: Floats,
    face: NDArray[np.int32],
) -> None:
    """Where rays start...after enter a solid, if that is nearer than `distance`, which is set.

    A ray is inside between the last face that it enters by and the first that it leaves by.
    """
    for i in range(start, after):
        x, y, z = origins[i if len(origins) > 1 else 0]
        u, v, w = directions[i]
        entry, exit_, entered = -np.inf, distance[i], -1
        for k in range(len(faces)):
            inside, outside = _interval(faces, k, x, y, z, u, v, w)
            if inside > entry:
                entry, entered = inside, k
            exit_ = min(exit_, outside)
            if entry >= exit_:
                break
        if 0 < entry < exit_:
            distance[i] = entry
            face[i] = first + entered


@njit(cache=True)
def _interval(
    q: Floats, k: int, x: float, y: float, z: float, u: float, v: float, w: float
) -> tuple[float, float]:
    """Between which t on a ray p'Qp = a t^2 + 2 b t + c <= 0, Q = q[k]; (inf, -inf) for none."""
    a, b = 0.0, q[k, 3, 0] * u + q[k, 3, 1] * v + q[k, 3, 2] * w
    c = 2 * (q[k, 3, 0] * x + q[k, 3, 1] * y + q[k, 3, 2] * z) + q[k, 3, 3]
    if q[k, 0, 0] + q[k, 1, 1] + q[k, 2, 2] > 0:  # no plane
        for i in range(3):
            gradient = q[k, i, 0] * x + q[k, i, 1] * y + q[k, i, 2] * z
            a += (u, v, w)[i] * (q[k, i, 0] * u + q[k, i, 1] * v + q[k, i, 2] * w)
            b += (u, v, w)[i] * gradient
            c += (x, y, z)[i] * gradient
    if a < 1e-15:  # a plane, or along a cylinder's axis
        if b == 0:
            return (-np.inf, np.inf) if c <= 0 else (np.inf, -np.inf)
        return (-np.inf, -c / (2 * b)) if b > 0 else (-c / (2 * b), np.inf)
    if b * b < a * c:
        return np.inf, -np.inf
    root = np.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


def half_space(normal: ArrayLike, point: ArrayLike) -> Solid:
    """Everything behind the plane through `point` whose outward normal is `normal`."""
    unit = np.asarray(normal, np.float64)
    unit = unit / np.linalg.norm(unit)
    return _flat(np.append(unit, -unit @ np.asarray(point, np.float64))[None])


def prism(outline: ArrayLike, height: float, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Right prism over a convex polygon, moved by `rotation` (3, 3) and then by `centre` (3,).

    `outline` (M, 2) are the corners of its base, counter-clockwise, metres; its own z runs from
    -height / 2 to height / 2.
    """
    corners = np.asarray(outline, np.float64)
    edges = np.roll(corners, -1, axis=0) - corners
    x, y = edges[:, ::-1].T * ([[1], [-1]] / np.linalg.norm(edges, axis=1))
    upright = np.column_stack([x, y, np.zeros(len(x)), -(x * corners[:, 0] + y * corners[:, 1])])
    return _placed(_flat(np.vstack([upright, _caps(height)])), rotation, centre)


def box(size: ArrayLike, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Box of a size (3,) in metres, rotated (world-from-box) and centred at `centre`."""
    x, y, z = np.asarray(size, np.float64) / 2
    return prism([(-x, -y), (x, -y), (x, y), (-x, y)], 2 * z, rotation, centre)


def sphere(radius: float, centre: ArrayLike) -> Solid:
    """Ball of a radius in metres."""
    return _placed(Solid(np.diag([1.0, 1.0, 1.0, -(radius**2)])[None]), np.eye(3), centre)


def cylinder(radius: float, height: float, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Cylinder along its own z axis, with flat ends."""
    round_ = np.diag([1.0, 1.0, 0.0, -(radius**2)])
    faces = np.concatenate([_flat(_caps(height)).faces, round_[None]])
    return _placed(Solid(faces), rotation, centre)


def about_z(degrees: float) -> Floats:
    """Rotation about the vertical."""
    rotation: Floats = Rotation.from_euler('z', degrees, degrees=True).as_matrix()
    return rotation


def _caps(height: float) -> Floats:
    """Top and bottom, (2, 4), of a solid of that height about its origin."""
    return np.array([[0, 0, 1, -height / 2], [0, 0, -1, -height / 2]])


def _flat(planes: Floats) -> Solid:
    """The solid of planar faces: plane equations (F, 4)."""
    faces = np.zeros((len(planes), 4, 4))
    faces[:, 3] = faces[:, :, 3] = planes * (0.5, 0.5, 0.5, 1)
    return Solid(faces)


def _placed(solid: Solid, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Return the solid after p -> rotation @ p + centre."""
    back = np.eye(4)
    back[:3, :3] = np.asarray(rotation, np.float64).T
    back[:3, 3] = -back[:3, :3] @ np.asarray(centre, np.float64)
    return solid.transformed(back)
