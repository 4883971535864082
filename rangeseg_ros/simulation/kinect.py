"""Rooms as a Kinect sees them, with exact shadows of its projector and dark surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.render import Frame
from rangeseg_ros.simulation.scenes import Scene
from rangeseg_ros.simulation.sensors.kinect import (
    BASELINE,
    QUANTUM,
    SHADOW_SHARE,
    blind_zones,
    in_millimetres,
    kinect_camera,
    measured_disparity,
)
from rangeseg_ros.simulation.solids import cast, cosine_of_incidence, lit
from rangeseg_ros.simulation.truth import visible_regions

NOISES = ('measured', 'correlated', 'independent', 'none')


def simulate_kinect(
    scene: Scene,
    camera: Camera | None = None,
    *,
    frame: int = 0,
    noise: str = 'measured',
    sensor_seed: int = 0,
    seed: int = 0,
) -> Frame:
    """Depth image of a scene with its truth.

    Parameters
    ----------
    scene : Scene
        Solids and camera poses.
    camera : Camera, optional
        `kinect_camera()` when not given.
    frame : int
        Which of the scene's poses.
    noise : {'measured', 'correlated', 'independent', 'none'}
        measured: fixed distortion, vertical bands, correlated noise, blind zones (see
        `sensors.kinect`). independent: sigma = 0.0012 + 0.0019 (z - 0.4)^2 m
        (Nguyen, Izadi and Lovell 2012); correlated: the same, correlated over 1.5 pixels as by
        block matching. These three quantise disparity to 1/8 pixel and depth to millimetres.
        none: exact metres. All have the shadows of the projector.
    sensor_seed : int
        Which sensor: its distortion and bands.
    seed : int
        Noise of the frame, together with `frame`.

    Raises
    ------
    ValueError
        Unknown noise.
    """
    if noise not in NOISES:
        raise ValueError(f'noise must be one of {", ".join(NOISES)}, not {noise!r}')
    camera = camera or kinect_camera()
    pose = scene.poses[frame]
    rays = camera.rays.astype(np.float64)
    world_rays = rays @ pose.rotation.T
    depth, face = cast(scene.solids, pose.position, world_rays)
    depth[face < 0] = 1.0
    points = pose.position + depth[..., None] * world_rays
    baseline = BASELINE * (SHADOW_SHARE if noise == 'measured' else 1.0)
    projector = pose.position + baseline * pose.rotation[:, 0]
    face[~lit(scene.solids, projector, points)] = -1

    planes = scene.planes(pose)
    image: NDArray[np.uint16] | NDArray[np.float32]
    if noise == 'none':
        image = np.where(face >= 0, depth, 0).astype(np.float32)
    else:
        random = np.random.default_rng([seed, frame, 4])
        if noise == 'measured':
            slope = np.tan(np.arccos(cosine_of_incidence(rays, face, planes)))
            ragged = smooth_field(camera.shape, (2.5, 2.5), random)
            face[blind_zones(depth, slope, ragged)] = -1
            for *centre, radius in scene.dark:
                distance = np.linalg.norm(points - centre, axis=-1)
                face[distance < radius * (1 + 0.06 * ragged)] = -1
            disparity = measured_disparity(depth, slope, sensor_seed, random)
        else:
            field = smooth_field(
                camera.shape, (1.5, 1.5) if noise == 'correlated' else None, random
            )
            noisy = depth + (0.0012 + 0.0019 * (depth - 0.4) ** 2) * field
            disparity = 1 / (QUANTUM * np.maximum(noisy, 0.1))
        millimetres = in_millimetres(disparity)
        face[millimetres > 65535] = -1
        image = np.where(face >= 0, millimetres, 0).astype(np.uint16)
    labels, regions = visible_regions(face, planes)
    return Frame(image, labels, regions, camera)
