"""Depth image and truth of a scene, as any of the sensors sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.scenes import Scene
from rangeseg_ros.simulation.sensors.sensor import Sensor
from rangeseg_ros.simulation.solids import cast
from rangeseg_ros.simulation.truth import TruePlane, visible_regions


@dataclass(frozen=True, eq=False)
class Frame:
    """A simulated depth image and its truth.

    Attributes
    ----------
    depth : (H, W) uint16 or float32
        Along the optical axis: millimetres (uint16) or metres (float32); 0 = no measurement.
    labels : (H, W) uint16
        4-connected visible regions of planar faces; 0 = no measurement, 65535 = not planar.
    planes : list of TruePlane
        Their exact equations in the camera's optical frame.
    camera : Camera
        Intrinsics.
    """

    depth: NDArray[np.uint16] | NDArray[np.float32]
    labels: NDArray[np.uint16]
    planes: list[TruePlane]
    camera: Camera


def simulate(
    scene: Scene, sensor: Sensor, camera: Camera | None = None, *, frame: int = 0, seed: int = 0
) -> Frame:
    """Depth image of a scene with its truth: the face in the direction of each pixel.

    Parameters
    ----------
    scene : Scene
        Solids and camera poses.
    sensor : Sensor
        How it is measured.
    camera : Camera, optional
        The sensor's own when not given.
    frame : int
        Which of the scene's poses.
    seed : int
        Noise of the frame, together with `frame`.
    """
    camera = camera or sensor.camera
    pose = scene.poses[frame]
    rays = camera.rays.astype(np.float64) @ pose.rotation.T
    depth, face = cast(scene.solids, pose.position, rays)
    random = np.random.default_rng([seed, frame, 4])
    image = sensor.measure(depth, camera, random)
    # Exact depth, in metres, is that of renderings, which need no light.
    if image.dtype == np.uint16 and len(scene.dark):
        points = pose.position + np.where(face >= 0, depth, 1.0)[..., None] * rays
        ragged = 1 + 0.06 * smooth_field(camera.shape, (2.5, 2.5), random)
        for *centre, radius in scene.dark:
            image[np.linalg.norm(points - centre, axis=-1) < radius * ragged] = 0
    labels, planes = visible_regions(np.where(image > 0, face, -1), scene.planes(pose))
    return Frame(image, labels, planes, camera)
