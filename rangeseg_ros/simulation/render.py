"""Depth image and truth of a scene, as any of the sensors sees it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Singles
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.scenes import Scene
from rangeseg_ros.simulation.sensors.sensor import Sensor
from rangeseg_ros.simulation.solids import cast

NOT_PLANAR = 65535
"""Truth label of pixels on curved surfaces."""


@dataclass(frozen=True, eq=False)
class TruePlane:
    """Exact plane of a visible region of `count` pixels, in the sensor's frame, metres.

    normal . p + distance = 0, with the unit normal (3,) towards the sensor. `label` is its value
    in the truth image, 1...; `face` the number of its face in the scene, which persists from frame
    to frame and is shared by all regions into which occluders cut the face.
    """

    label: int
    face: int
    normal: Floats
    distance: float
    count: int


@dataclass(frozen=True, eq=False)
class Frame:
    """A simulated depth image, its truth, and its camera.

    `depth` (H, W) is along the optical axis, millimetres (uint16) or metres (float32), 0 = no
    measurement; `labels` (H, W) are the 4-connected visible regions of planar faces, 0 = no
    measurement, `NOT_PLANAR` on curved ones.
    """

    depth: NDArray[np.uint16] | Singles
    labels: NDArray[np.uint16]
    planes: list[TruePlane]
    camera: Camera


def simulate(
    scene: Scene, sensor: Sensor, camera: Camera | None = None, *, frame: int = 0, seed: int = 0
) -> Frame:
    """Depth image of a scene with its truth: the face in the direction of each pixel.

    The camera is the sensor's own when none is given, the pose that of the number `frame`; the
    noise follows from `seed` and `frame`.
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


def visible_regions(
    face: NDArray[np.int32], planes: Floats
) -> tuple[NDArray[np.uint16], list[TruePlane]]:
    """4-connected regions of the planar faces seen in an image.

    `face` (H, W) is the number of the face that each pixel sees, -1 where nothing was measured;
    `planes` (F, 4) are the equations of all faces, NaN of curved ones. The labels (H, W) are 0
    where nothing was measured, `NOT_PLANAR` on curved faces, else 1, 2, ... by face and then in
    reading order, as the regions are.
    """
    labels = np.zeros(face.shape, np.uint16)
    regions: list[TruePlane] = []
    for number in np.unique(face[face >= 0]).tolist():
        mask = face == number
        normal, distance = planes[number, :3], float(planes[number, 3])
        if np.isnan(distance):
            labels[mask] = NOT_PLANAR
            continue
        count, components = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
        if len(regions) + count > NOT_PLANAR:
            raise ValueError(f'more than {NOT_PLANAR - 1} visible regions')
        labels[mask] = components[mask] + len(regions)
        for size in np.bincount(components[mask])[1:].tolist():
            regions.append(TruePlane(len(regions) + 1, number, normal, distance, size))
    return labels, regions
