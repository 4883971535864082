"""What a simulated sensor is, and the geometry that all of them need."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Mask, Singles
from rangeseg_ros.core.sensing.camera import Camera


@dataclass(frozen=True)
class Sensor(ABC):
    """A depth camera: how it errs, and what it does not see.

    Sizes in pixels that come from matching windows and filters are those of the image at hand;
    fixed patterns stretch with the image.

    Attributes
    ----------
    seed : int
        Which one of its kind: its fixed errors.
    camera : Camera
        Intrinsics of its usual mode.
    """

    seed: int = 0
    camera: ClassVar[Camera]

    @abstractmethod
    def measure(
        self, depth: Floats, camera: Camera, random: np.random.Generator
    ) -> NDArray[np.uint16] | Singles:
        """Depth image (H, W) as the sensor delivers it: millimetres, or metres as float32.

        Both the image, where 0 stands for no measurement, and the true `depth` (metres, inf where
        there is nothing) are along the optical axis; `random` gives what is new in every frame.
        """


class Ideal(Sensor):
    """Exact depth in metres (float32), everywhere: renderings."""

    camera = Camera(640, 480, 585.0, 585.0, 319.5, 239.5)

    def measure(self, depth: Floats, camera: Camera, random: np.random.Generator) -> Singles:
        return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def resize(camera: Camera, width: int, height: int) -> Camera:
    """Camera whose image of the same horizontal field of view has another size."""
    focal = camera.fx * width / camera.width
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def inverse_depth(depth: Floats) -> Floats:
    """1/z, 1/m; 0 where there is nothing."""
    return 1 / np.maximum(depth, 1e-3)


def slopes(inverse: Floats, camera: Camera) -> Floats:
    """Tangent of the angle of incidence of every pixel's surface.

    A plane is theta . ray = 1/z, so the derivatives of 1/z along rows and columns give its
    normal; of the two one-sided differences the smaller one does not cross an edge.
    """
    rays = camera.rays.astype(np.float64)
    theta_x, theta_y = (
        focal * _derivative(inverse, axis) for focal, axis in ((camera.fx, 1), (camera.fy, 0))
    )
    theta_z = inverse - theta_x * rays[..., 0] - theta_y * rays[..., 1]
    norm = np.sqrt(theta_x**2 + theta_y**2 + theta_z**2) * np.linalg.norm(rays, axis=-1)
    cosine = np.clip(inverse / np.maximum(norm, 1e-12), 1e-3, 1)
    return np.sqrt(1 - cosine**2) / cosine


def _derivative(image: Floats, axis: int) -> Floats:
    step = np.diff(image, axis=axis)
    first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
    forward = np.concatenate([step, last], axis)
    backward = np.concatenate([first, step], axis)
    return np.where(np.abs(forward) < np.abs(backward), forward, backward)


def unseen_from_the_right(inverse: Floats, camera: Camera, baseline: float) -> Mask:
    """Pixels that a second view, `baseline` metres to the right, does not see.

    A pixel lands at u - f b / z in that view (rectified stereo); a pixel further right that
    lands further left is nearer, and hides it. The shadows lie left of what casts them.
    """
    columns = np.arange(camera.width) - camera.fx * baseline * inverse
    nearest = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(inverse.shape, np.bool_)
    # Within half a pixel it is the same surface, seen at a grazing angle.
    hidden[:, :-1] = columns[:, :-1] > nearest[:, 1:] + 0.5
    return hidden


def millimetres(depth: Floats, seen: Mask) -> NDArray[np.uint16]:
    """Depth image in millimetres; 0 where nothing is seen or 16 bits do not hold it."""
    values = np.rint(1000 * np.where(seen, depth, 0))
    return np.where((values >= 1) & (values <= 65535), values, 0).astype(np.uint16)
