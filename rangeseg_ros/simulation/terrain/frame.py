"""A terrain as a sensor measures it, with the truth of every pixel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Mask, Singles
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.sensors.sensor import Sensor
from rangeseg_ros.simulation.solids import cast
from rangeseg_ros.simulation.terrain.scene import Terrain

LEAST = 0.05
"""Height from which on something is an obstacle, and depth from which on a drop, metres."""


class TerrainFrame(NamedTuple):
    """A simulated depth image, as the sensor delivers it, and its truth; all (H, W), metres.

    `terrain` is the true class, 0 where nothing is measured or the class is not judged (lower than
    obstacles, less deep than drops). `height` is that above the ground below the point, NaN where
    nothing is measured; `size` the height of the whole object, or the depth of the drop, 0 for
    ground; `crossing` the depth at which the ray crosses the ground continued, inf for none.
    """

    depth: NDArray[np.uint16] | Singles
    terrain: NDArray[np.uint8]
    height: Singles
    size: Singles
    crossing: Singles


def simulate_terrain(
    scene: Terrain, sensor: Sensor, camera: Camera | None = None, seed: int = 0
) -> TerrainFrame:
    """Depth image of a terrain with its truth; the camera is the sensor's own when none is given.

    `seed` is that of the frame's noise.
    """
    camera = camera or sensor.camera
    origin = scene.pose.position
    rays = camera.rays.astype(np.float64) @ scene.pose.rotation.T
    depth, face = cast([piece.solid for piece in scene.pieces], origin, rays)
    last = np.cumsum([len(piece.solid.faces) for piece in scene.pieces])
    piece = np.where(face < 0, -1, np.searchsorted(last, face, side='right'))
    said = [(p.terrain, p.size, p.seen == 'mirror', p.seen == 'nothing') for p in scene.pieces]
    columns = zip(*said, (UNKNOWN, 0.0, False, False), strict=True)
    terrain, size, mirror, hidden = (np.array(column)[piece] for column in columns)
    if mirror.any():
        flip = np.diag([1.0, 1.0, -1.0, 1.0])
        images = [p.solid.transformed(flip) for p in scene.pieces if p.terrain == OBSTACLE]
        depth[mirror], _ = cast(images, origin, rays[mirror])
    on_ground = terrain == GROUND
    depth[on_ground] = _on_waves(scene, rays[on_ground], depth[on_ground])
    points = origin + np.where(np.isfinite(depth), depth, 1)[..., None] * rays
    lifted = scene.wave_height(points)
    height = points[..., 2] - _ground_below(scene, points) - lifted
    size = np.where(mirror, -height, size - lifted)

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
        terrain.astype(np.uint8),
        np.where(measured > 0, height, np.nan).astype(np.float32),
        size.astype(np.float32),
        crossing.astype(np.float32),
    )


def _with_relief(
    measured: NDArray[np.uint16] | Singles, relief: float, ground: Mask, rays: Floats, seed: int
) -> NDArray[np.uint16] | Singles:
    """Depth of rough ground: each pixel sees a stone or a blade of grass, `relief` (sd, m)."""
    off = relief * np.random.default_rng([seed, 14]).standard_normal(measured.shape)
    off *= (1000 if measured.dtype == np.uint16 else 1) / np.minimum(rays[..., 2], -0.1)
    rough = np.maximum(measured + np.clip(off, -0.3 * measured, 0.3 * measured), 0)
    return np.where(ground & (measured > 0), rough.astype(measured.dtype), measured)


def _on_waves(scene: Terrain, rays: Floats, depth: Floats) -> Floats:
    """Depth of rays that meet the ground at `depth` without the waves."""
    origin = scene.pose.position
    flat = (origin + depth[:, None] * rays)[:, 2]
    for _ in range(8 if scene.waves else 0):
        points = origin + depth[:, None] * rays
        depth = depth - (points[:, 2] - flat - scene.wave_height(points)) / rays[:, 2]
    return depth


def _ground_below(scene: Terrain, points: Floats) -> Floats:
    """Height of the ground continued, without waves, at the places of points (H, W, 3)."""
    above = points.copy()
    above[..., 2] = 20.0
    depth, _ = cast(scene.ground, above, np.broadcast_to([0.0, 0.0, -1.0], points.shape))
    return np.where(np.isfinite(depth), 20.0 - depth, 0)
