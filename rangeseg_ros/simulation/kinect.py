"""Kinect-type structured-light camera: depth image and truth of a scene.

The model and its figures were measured on real frames of five sensors (residuals of 107
hand-annotated planes). The unit is one disparity quantum, 1/8 pixel, in which almost every
effect is constant: 1/z = 0.00290 * disparity, z in metres, so that one quantum is 2.9 mm at
1 m and 26 mm at 3 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.scenes import Scene
from rangeseg_ros.simulation.solids import cast, cosine_of_incidence, lit
from rangeseg_ros.simulation.truth import TruePlane, visible_regions

NOISES = ('measured', 'correlated', 'independent', 'none')
QUANTUM = 0.00290
"""Inverse depth of one disparity quantum, 1/m."""
BASELINE = 0.075
"""Distance of the projector to the right of the camera, metres."""
SHADOW_SHARE = 0.75
"""Part of a shadow's geometric width that real sensors leave blank (median)."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A simulated depth image and its truth.

    Attributes
    ----------
    depth : (H, W) uint16 or float32
        Along the optical axis: millimetres (uint16) or, without noise, metres (float32);
        0 = no measurement.
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


def kinect_camera(width: int = 640, height: int = 480) -> Camera:
    """Intrinsics of a Kinect whose image of the same field of view has that many columns."""
    focal = 585.0 * width / 640
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


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
        `measured_disparity` and `_blind`). independent: sigma = 0.0012 + 0.0019 (z - 0.4)^2 m
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
            face[_blind(depth, slope, points, scene.dark, random)] = -1
            disparity = measured_disparity(depth, slope, sensor_seed, random)
        else:
            field = smooth_field(
                camera.shape, (1.5, 1.5) if noise == 'correlated' else None, random
            )
            noisy = depth + (0.0012 + 0.0019 * (depth - 0.4) ** 2) * field
            disparity = 1 / (QUANTUM * np.maximum(noisy, 0.1))
        millimetres = np.rint(1000 / (QUANTUM * np.maximum(np.rint(disparity), 1)))
        # One quantum of disparity stands for infinity: nothing is measured beyond 65 m.
        face[millimetres > 65535] = -1
        image = np.where(face >= 0, millimetres, 0).astype(np.uint16)
    labels, regions = visible_regions(face, planes)
    return Frame(image, labels, regions, camera)


def measured_disparity(
    depth: NDArray[np.float64],
    slope: NDArray[np.float64],
    sensor_seed: int,
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Disparity, in quanta and before rounding, as real sensors see `depth`.

    The sum of the true disparity, `sensor_pattern`, a smooth distortion new in every frame with
    a quarter of the pattern's variance, and pixel noise of 0.37 quanta correlated over 2 pixels
    that grows with obliquity. These reproduce the 0.45 quanta of residual noise (quantisation
    included) and its autocorrelation (0.5 at 1.4-1.9 pixels) of real frames.

    Parameters
    ----------
    depth : (H, W) float64
        True depth, metres.
    slope : (H, W) float64
        Tangent of the angle of incidence.
    sensor_seed : int
        Which sensor.
    random : Generator
        Source of what is new in every frame.
    """
    fresh = 0.25 * smooth_field(depth.shape, _distortion_scale(depth.shape[1]), random)
    noise = 0.37 * (1 + 0.25 * np.maximum(slope - 0.7, 0))
    noise = noise * smooth_field(depth.shape, (2.0, 2.0), random)
    return 1 / (QUANTUM * depth) + sensor_pattern(depth.shape, sensor_seed) + fresh + noise


@lru_cache(maxsize=4)
def sensor_pattern(shape: tuple[int, ...], sensor_seed: int) -> NDArray[np.float64]:
    """Fixed error of one sensor, (H, W) quanta of disparity.

    A smooth distortion (standard deviation 0.5, correlated over 26 columns and 45 rows of a
    640x480 image, twice as strong at the left and right borders) and vertical bands: steps of
    0.4 to 1.0 every 75 to 105 columns, or one of 0.75 at the middle column, ramped back between.
    """
    width = shape[1]
    random = np.random.default_rng([sensor_seed, 5])
    scale = width / 640
    column = np.arange(width)
    border = np.minimum(column, width - 1 - column) / scale
    # Twice as strong within 60 columns of the border, without a step where that begins.
    strength = 0.5 * (1 + np.clip((75 - border) / 30, 0, 1))
    distortion = strength * smooth_field(shape, _distortion_scale(width), random)
    if random.random() < 0.5:
        step, period, first = 0.75, float(width), width / 2
    else:
        step, period = random.uniform(0.4, 1.0), random.uniform(75, 105) * scale
        first = random.uniform(0, period)
    step *= random.choice([-1, 1])
    bands = step * (((column - first) / period) % 1 - 0.5)
    pattern: NDArray[np.float64] = distortion + bands
    pattern.setflags(write=False)
    return pattern


def _distortion_scale(width: int) -> tuple[float, float]:
    """Kernel widths of the smooth distortion over columns and rows, pixels."""
    return 26 * width / 640, 45 * width / 640


def smooth_field(
    shape: tuple[int, ...], sigma: tuple[float, float] | None, random: np.random.Generator
) -> NDArray[np.float64]:
    """Gaussian random field of unit variance: white noise smoothed over columns and rows.

    Parameters
    ----------
    shape : (int, int)
        Height and width.
    sigma : (float, float) or None
        Standard deviations of the Gaussian kernel along a row and along a column, pixels;
        None for white noise.
    random : Generator
        Source of randomness.
    """
    if sigma is None:
        return random.standard_normal(shape)
    pad_x, pad_y = (int(np.ceil(4 * s)) for s in sigma)
    white = random.standard_normal((shape[0] + 2 * pad_y, shape[1] + 2 * pad_x))
    kernel_x, kernel_y = (
        cv2.getGaussianKernel(2 * pad + 1, s) for pad, s in zip((pad_x, pad_y), sigma, strict=True)
    )
    gain = np.linalg.norm(kernel_x) * np.linalg.norm(kernel_y)
    field = cv2.sepFilter2D(white, cv2.CV_64F, kernel_x, kernel_y) / gain
    inside: NDArray[np.float64] = field[pad_y : pad_y + shape[0], pad_x : pad_x + shape[1]]
    return inside


def _blind(
    depth: NDArray[np.float64],
    slope: NDArray[np.float64],
    points: NDArray[np.float64],
    dark: NDArray[np.float64],
    random: np.random.Generator,
) -> NDArray[np.bool_]:
    """(H, W) True where real sensors measure nothing, shadows apart.

    Nearer than 0.8 m, in the last eight columns, on dark places and, with ragged borders, on
    surfaces seen at more than about 80 degrees.
    """
    ragged = smooth_field(depth.shape, (2.5, 2.5), random)
    blind = np.degrees(np.arctan(slope)) + 2 * ragged > 80
    for *centre, radius in dark:
        blind |= np.linalg.norm(points - centre, axis=-1) < radius * (1 + 0.06 * ragged)
    blind |= depth < 0.8
    blind[:, -8:] = True
    return blind
