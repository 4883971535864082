"""A terrain as a sensor measures it, with the truth of every pixel.

World frame: x ahead, y to the left, z up, metres; the robot stands at the origin on z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.ground.classes import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.sensors.sensor import Sensor
from rangeseg_ros.simulation.solids import Solid, cast
from rangeseg_ros.simulation.terrain.scene import Piece, Terrain, Wave

LEAST = 0.05
"""Height from which on something is an obstacle, and depth from which on a drop, metres."""


class TerrainFrame(NamedTuple):
    """A simulated depth image and its truth.

    Attributes
    ----------
    depth : (H, W) uint16 or float32
        As the sensor delivers it.
    terrain : (H, W) uint8
        True class; 0 where nothing is measured or the class is not judged (lower than
        obstacles, less deep than drops).
    height : (H, W) float32
        True height above the ground below the point, metres; NaN where nothing is measured.
    size : (H, W) float32
        Height of the whole object, or depth of the drop, metres; 0 for ground.
    crossing : (H, W) float32
        Depth at which the ray crosses the ground continued, metres; inf where it does not.
    """

    depth: NDArray[np.uint16] | NDArray[np.float32]
    terrain: NDArray[np.uint8]
    height: NDArray[np.float32]
    size: NDArray[np.float32]
    crossing: NDArray[np.float32]


def simulate_terrain(
    scene: Terrain, sensor: Sensor, camera: Camera | None = None, seed: int = 0
) -> TerrainFrame:
    """Depth image of a terrain with its truth.

    Parameters
    ----------
    scene : Terrain
    sensor : Sensor
        How it is measured.
    camera : Camera, optional
        The sensor's own when not given.
    seed : int
        Of the frame's noise.
    """
    camera = camera or sensor.camera
    origin = scene.pose.position
    rays = camera.rays.astype(np.float64) @ scene.pose.rotation.T
    depth, piece = _first_hit([p.solid for p in scene.pieces], origin, rays)
    mirror = _of(scene, piece, lambda p: p.seen == 'mirror', False)
    if mirror.any():
        images = [p for p in scene.pieces if p.terrain == OBSTACLE]
        behind, _ = cast([_mirrored(p.solid) for p in images], origin, rays[mirror])
        depth[mirror] = behind
    terrain = _of(scene, piece, lambda p: p.terrain, UNKNOWN).astype(np.uint8)
    size = _of(scene, piece, lambda p: p.size, 0.0)
    on_ground = terrain == GROUND
    depth[on_ground] = _on_waves(scene.waves, origin, rays[on_ground], depth[on_ground])
    points = origin + np.where(np.isfinite(depth), depth, 1)[..., None] * rays
    height = points[..., 2] - _ground_below(scene, points)
    lifted = sum((wave.height(points) for wave in scene.waves), np.zeros(depth.shape))
    size = np.where(mirror, -height, size - lifted)

    hidden = _of(scene, piece, lambda p: p.seen == 'nothing', False)
    measured = sensor.measure(
        np.where(hidden, np.inf, depth), camera, np.random.default_rng([seed, 12])
    )
    if scene.relief:
        measured = _with_relief(measured, scene.relief, on_ground, rays, seed)
    terrain[(measured == 0) | ((terrain != GROUND) & (size < LEAST))] = UNKNOWN
    terrain[(terrain == DROP) & (height > -LEAST)] = UNKNOWN
    crossing, _ = cast(scene.ground, origin, rays)
    return TerrainFrame(
        measured,
        terrain,
        np.where(measured > 0, height, np.nan).astype(np.float32),
        size.astype(np.float32),
        crossing.astype(np.float32),
    )


def _with_relief(
    measured: NDArray[np.uint16] | NDArray[np.float32],
    relief: float,
    ground: NDArray[np.bool_],
    rays: NDArray[np.float64],
    seed: int,
) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Depth of rough ground: each pixel sees a stone or a blade of grass, `relief` (sd, m)."""
    off = relief * np.random.default_rng([seed, 14]).standard_normal(measured.shape)
    off *= (1000 if measured.dtype == np.uint16 else 1) / np.minimum(rays[..., 2], -0.1)
    rough = np.maximum(measured + np.clip(off, -0.3 * measured, 0.3 * measured), 0)
    result = measured.copy()
    result[ground & (measured > 0)] = rough[ground & (measured > 0)]
    return result


def _first_hit(
    solids: list[Solid], origin: NDArray[np.float64], rays: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Depth of the first hit of every ray, and which solid it is; inf and -1 for none."""
    depth, face = cast(solids, origin, rays)
    last = np.cumsum([solid.face_count for solid in solids])
    return depth, np.where(face < 0, -1, np.searchsorted(last, face, side='right'))


def _of(
    scene: Terrain, piece: NDArray[np.intp], value: Callable[[Piece], object], none: object
) -> NDArray:
    """What is said of the pieces that the pixels see."""
    return np.array([*map(value, scene.pieces), none])[piece]


def _mirrored(solid: Solid) -> Solid:
    """The image of a solid in the plane z = 0."""
    flip = np.array([1.0, 1.0, -1.0])
    quadric = solid.quadric
    if quadric is not None:
        turn = np.append(flip, 1.0)
        quadric = quadric * np.outer(turn, turn)
    return Solid(solid.normals * flip, solid.offsets, quadric)


def _on_waves(
    waves: tuple[Wave, ...],
    origin: NDArray[np.float64],
    rays: NDArray[np.float64],
    depth: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Depth of rays that meet the ground at `depth` without the waves."""
    flat = (origin + depth[:, None] * rays)[:, 2]
    for _ in range(8 if waves else 0):
        points = origin + depth[:, None] * rays
        above = points[:, 2] - flat - sum(wave.height(points) for wave in waves)
        depth = depth - above / rays[:, 2]
    return depth


def _ground_below(scene: Terrain, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the ground continued at the places of points (H, W, 3)."""
    above = points.copy()
    above[..., 2] = 20.0
    depth, _ = cast(scene.ground, above, np.broadcast_to([0.0, 0.0, -1.0], points.shape))
    level = np.where(np.isfinite(depth), 20.0 - depth, 0)
    return level + sum((wave.height(points) for wave in scene.waves), np.zeros(depth.shape))
