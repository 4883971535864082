"""Convex solids and exact ray casting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.runtime.threads import run_rows


@dataclass(frozen=True, eq=False)
class Solid:
    """Points p with normals @ p + offsets <= 0 and, when there is a quadric, p'Qp <= 0.

    Attributes
    ----------
    normals : (K, 3) float64
        Outward unit normals of the planar faces.
    offsets : (K,) float64
        Offsets of the faces, metres.
    quadric : (4, 4) float64 or None
        Symmetric matrix of a convex quadric in homogeneous coordinates; the solid's last face.
    """

    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    quadric: NDArray[np.float64] | None = None

    @property
    def face_count(self) -> int:
        """Number of faces, the curved one included."""
        return len(self.offsets) + (self.quadric is not None)

    @property
    def planes(self) -> NDArray[np.float64]:
        """(face_count, 4) plane equations (normal, offset); NaN for the curved face."""
        planes = np.full((self.face_count, 4), np.nan)
        planes[: len(self.offsets)] = np.column_stack([self.normals, self.offsets])
        return planes


def cast(
    solids: Sequence[Solid], origins: ArrayLike, directions: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """First hit of every ray.

    Parameters
    ----------
    solids : sequence of Solid
        Faces are numbered through all solids, in their order.
    origins : (3,) or (..., 3) array_like
        One origin for all rays, or one for each.
    directions : (..., 3) array_like
        Directions, of any length.

    Returns
    -------
    distance : (...) float64
        Ray parameter of the hit, in lengths of the direction; inf where nothing is hit.
    face : (...) int32
        Number of the face hit, -1 where nothing is.
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
            solid.normals,
            solid.offsets,
            quadric,
            first,
            distance,
            face,
        )
        first += solid.face_count
    return distance.reshape(shape), face.reshape(shape)


_NONE = np.zeros((0, 0))


@njit(cache=True, nogil=True)
def _enter(
    start: int,
    after: int,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    normals: NDArray[np.float64],
    offsets: NDArray[np.float64],
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
        for k in range(len(offsets)):
            rate = normals[k, 0] * u + normals[k, 1] * v + normals[k, 2] * w
            height = normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * z + offsets[k]
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
                entry, entered = inside, len(offsets)
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
    return Solid(unit[None], -np.array([unit @ np.asarray(point, np.float64)]))


def prism(outline: ArrayLike, height: float, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Right prism over a convex polygon.

    Parameters
    ----------
    outline : (M, 2) array_like
        Corners of the base, counter-clockwise, metres.
    height : float
        Height of the prism along its own z axis; z runs from -height / 2 to height / 2.
    rotation : (3, 3) array_like
        World-from-solid rotation.
    centre : (3,) array_like
        World position of the solid's origin.
    """
    corners = np.asarray(outline, np.float64)
    edges = np.roll(corners, -1, axis=0) - corners
    sides = np.column_stack([edges[:, 1], -edges[:, 0], np.zeros(len(edges))])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    normals = np.vstack([sides, [[0, 0, 1], [0, 0, -1]]])
    offsets = -np.append((sides[:, :2] * corners).sum(axis=1), [height / 2, height / 2])
    return _placed(Solid(normals, offsets), rotation, centre)


def box(size: ArrayLike, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Box of a size (3,) in metres, rotated (world-from-box) and centred at `centre`."""
    x, y, z = np.asarray(size, np.float64) / 2
    return prism([(-x, -y), (x, -y), (x, y), (-x, y)], 2 * z, rotation, centre)


def sphere(radius: float, centre: ArrayLike) -> Solid:
    """Ball of a radius in metres."""
    quadric = np.diag([1.0, 1.0, 1.0, -(radius**2)])
    return _placed(Solid(np.zeros((0, 3)), np.zeros(0), quadric), np.eye(3), centre)


def cylinder(radius: float, height: float, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Cylinder along its own z axis, with flat ends."""
    normals, offsets = np.array([[0.0, 0, 1], [0, 0, -1]]), np.full(2, -height / 2)
    quadric = np.diag([1.0, 1.0, 0.0, -(radius**2)])
    return _placed(Solid(normals, offsets, quadric), rotation, centre)


def _placed(solid: Solid, rotation: ArrayLike, centre: ArrayLike) -> Solid:
    """Return the solid after p -> rotation @ p + centre."""
    rotation, centre = np.asarray(rotation, np.float64), np.asarray(centre, np.float64)
    normals = solid.normals @ rotation.T
    offsets = solid.offsets - normals @ centre
    quadric = solid.quadric
    if quadric is not None:
        back = np.eye(4)
        back[:3, :3], back[:3, 3] = rotation.T, -rotation.T @ centre
        quadric = back.T @ quadric @ back
    return Solid(normals, offsets, quadric)
