"""Twins of the two scanners of the segmentation comparison of Hoover et al.

The published sets show the kind of the noise, not its level; the levels are chosen:

ABW (structured light, 8 bits; one quantum is 1.3 mm). The thesis calls its noise much lower than
the Perceptron's and describes flat steps, many pixels wide, on inclined planes (6.7.1). Such
steps survive only noise well below half a quantum; here it is 0.2 quanta.

Perceptron (phase-shift laser, 12 bits; one quantum is 2.0 mm). The thesis finds more noise on
surfaces slanted away and along edges, and attributes it to the weaker signal that returns (5.9).
With a photon-limited receiver [1]_ the standard deviation goes as range / sqrt(cos(incidence)).
It is scaled to 2.5 quanta (5 mm) at 3 m head-on, which makes 3-5 quanta on slanted faces, and is
three times as large in the two pixels on either side of an edge. With that the thesis's method
and parameters (lambda 55, one-pixel normals, Sobel edges, identification) find 94, 94, 94, 92, 85
and 67 % of the regions at 51, 60, 70, 80, 90 and 95 % overlap (the 30 test images); published for
the real set are 78, 78, 76, 70, 48 and 24 %. The twin is the easier set: its faces are clean, and
its truth is exact to the pixel, where that of the real set was drawn by hand.

References
----------
.. [1] D. Nitzan, A. E. Brain, R. O. Duda, "The measurement and use of registered reflectance and
   range data in scene analysis", Proceedings of the IEEE 65(2), 1977.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.segcomp.geometry import (
    AbwCalibration,
    perceptron_rays,
    perceptron_values,
)
from rangeseg_ros.simulation.polyhedra import polyhedral_scene
from rangeseg_ros.simulation.scenes import Scene
from rangeseg_ros.simulation.solids import cast, cosine_of_incidence, lit
from rangeseg_ros.simulation.truth import TruePlane, visible_regions

ABW_NOISE = 0.2
ABW_PROJECTOR = (0.25, 0.0, 0.0)
"""Projector in the camera's frame, metres: it makes shadows to the left of objects."""
PERCEPTRON_NOISE = 2.5
PERCEPTRON_EDGE_NOISE = 3.0


@dataclass(frozen=True, eq=False)
class Scan:
    """A simulated range image and its truth.

    Attributes
    ----------
    values : (512, 512) uint8 or uint16
        Range values as in the scanner's files; in ABW images 0 = shadow.
    labels : (512, 512) uint16
        4-connected visible regions; 0 = shadow.
    planes : list of TruePlane
        Their equations in metres, in the optical frame of `evaluation.segcomp_geometry`.
    """

    values: NDArray[np.uint8] | NDArray[np.uint16]
    labels: NDArray[np.uint16]
    planes: list[TruePlane]


def abw_scene(seed: int) -> Scene:
    """Objects of 3 to 9 cm, 0.95 m away: within the 8 bits of the ABW scanner."""
    return polyhedral_scene(seed, distance=0.95, width=0.30, pitch=(25, 45))


def perceptron_scene(seed: int) -> Scene:
    """Objects of 0.3 to 0.9 m, 3.7 m away: beyond the 1.7 m where the 12 bits begin."""
    return polyhedral_scene(seed, distance=3.7, width=3.3, pitch=(24, 36))


def simulate_abw(scene: Scene, calibration: AbwCalibration, seed: int) -> Scan:
    """Range image of the ABW scanner, with the shadows of its projector.

    Parameters
    ----------
    scene : Scene
        Such as `abw_scene`; what lies outside of the 8 bits becomes shadow.
    calibration : AbwCalibration
        One of the scanner's two.
    seed : int
        Noise of the image.
    """
    pose = scene.poses[0]
    rays = calibration.camera.rays.astype(np.float64)
    world_rays = rays @ pose.rotation.T
    depth, face = cast(scene.solids, pose.position, world_rays)
    depth[face < 0] = 1.0
    projector = pose.position + pose.rotation @ ABW_PROJECTOR
    points = pose.position + depth[..., None] * world_rays
    face[~lit(scene.solids, projector, points)] = -1
    random = np.random.default_rng([seed, 7])
    noise = ABW_NOISE * random.standard_normal(depth.shape)
    values = np.rint(calibration.values(depth) + noise)
    face[(values < 1) | (values > 255)] = -1
    labels, planes = visible_regions(face, scene.planes(pose))
    return Scan(np.where(face >= 0, values, 0).astype(np.uint8), labels, planes)


def simulate_perceptron(scene: Scene, seed: int) -> Scan:
    """Range image of the Perceptron scanner: one cast along each of its mirrored beams.

    Parameters
    ----------
    scene : Scene
        Such as `perceptron_scene`.
    seed : int
        Noise of the image.

    Raises
    ------
    ValueError
        A beam that hits nothing within the scanner's 12 bits: it has no way to say so.
    """
    pose = scene.poses[0]
    rays = perceptron_rays()
    origins = pose.position + rays.origins @ pose.rotation.T
    distance, face = cast(scene.solids, origins, rays.directions @ pose.rotation.T)
    planes = scene.planes(pose)
    cosine = cosine_of_incidence(rays.directions, face, planes)
    sigma = PERCEPTRON_NOISE * (distance / 3.0) / np.sqrt(np.maximum(cosine, 0.05))
    sigma[_beside_edges(face)] *= PERCEPTRON_EDGE_NOISE
    random = np.random.default_rng([seed, 8])
    values = np.rint(perceptron_values(distance) + sigma * random.standard_normal(face.shape))
    if not (values.min() >= 0 and values.max() <= 4095):
        raise ValueError('the scene exceeds the range of the Perceptron scanner')
    labels, regions = visible_regions(face, planes)
    return Scan(values.astype(np.uint16), labels, regions)


def _beside_edges(face: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(H, W) True within two pixels of another face."""
    square = np.ones((5, 5), np.uint8)
    image = face.astype(np.float32)
    return cv2.dilate(image, square) != cv2.erode(image, square)
