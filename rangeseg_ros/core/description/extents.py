"""Area, principal axes and extents of regions on their planes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.moments import ray_of
from rangeseg_ros.core.sensing.range_image import RangeImage

# A pixel's place on its plane is taken seriously up to this many times its measured range.
_FAR = 2.0


def areas_and_axes(
    labels: NDArray[np.uint16],
    image: RangeImage,
    theta: NDArray[np.float64],
    tangents: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Area of regions and the axis along which they are longest.

    Parameters
    ----------
    labels : (H, W) uint16
        0...M.
    image : RangeImage
        (H, W).
    theta : (M + 1, 3) float64
        Planes, theta . ray = inverse range.
    tangents : (M + 1, 2, 3) float64
        Two orthonormal vectors in each plane.

    Returns
    -------
    area : (M + 1,) float64
        Of the pixels' footprints on the plane, square metres.
    major : (M + 1, 3) float64
        Unit vector in the plane of the largest second moment of the area, to the image's right.
    """
    pixels = image.inverse, image.rays, image.pinhole, _footprints(image)
    upper, lower = map_halves(_area_moments, len(labels), labels, *pixels, theta, tangents)
    sums = upper + lower
    # With rays r + t du + s dv the area on n . p + d = 0 is d^2 |du x dv . r| / |n . r|^3.
    area = sums[:, 0] * np.linalg.norm(theta, axis=1)
    mean = sums[:, 1:3] / np.maximum(sums[:, :1], 1e-300)
    uu, uv, vv = (
        sums[:, 3 + k] - sums[:, 0] * mean[:, a] * mean[:, b]
        for k, (a, b) in enumerate(((0, 0), (0, 1), (1, 1)))
    )
    turn = 0.5 * np.arctan2(2 * uv, uu - vv)[:, None]
    major = np.cos(turn) * tangents[:, 0] + np.sin(turn) * tangents[:, 1]
    return area, major * np.where(major @ image.axes[:, :1] < 0, -1.0, 1.0)


def rectangles(
    labels: NDArray[np.uint16],
    image: RangeImage,
    theta: NDArray[np.float64],
    axes: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Rectangles around regions on their planes.

    Parameters
    ----------
    labels, image, theta
        As for `areas_and_axes`.
    axes : (M + 1, 2, 3) float64
        Directions of the rectangles' sides.

    Returns
    -------
    (M + 1, 2, 2) float64
        Smallest and largest coordinate along each axis, metres; of the corners of the pixels for
        a pinhole camera, of their centres otherwise. Not finite without pixels.
    """
    camera = image.camera
    half = (0.5 / camera.fx, 0.5 / camera.fy) if camera and camera.pinhole else (0.0, 0.0)
    arrays = labels, image.inverse, image.rays, image.pinhole, theta, axes
    upper, lower = map_halves(_limits, len(labels), *arrays, image.axes[:, :2] * half)
    # Smallest and largest.
    return np.stack([np.minimum(upper, lower)[..., 0], np.maximum(upper, lower)[..., 1]], axis=2)


def _footprints(image: RangeImage) -> NDArray[np.float32]:
    """|du x dv . r|, (H, W), of the rays r and their differences from pixel to pixel."""
    if image.camera and image.camera.pinhole:
        # An array like that of clouds, or the kernel that reads it is compiled twice.
        return np.full(image.shape, 1 / (image.camera.fx * image.camera.fy), np.float32)
    return _ray_footprints(image.rays, image.inverse)


@njit(cache=True)
def _ray_footprints(
    rays: NDArray[np.float32], inverse: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Footprints of rays that are known where something was measured."""
    height, width = inverse.shape
    result = np.zeros((height, width), np.float32)
    for i in range(height):
        for j in range(width):
            if inverse[i, j] == 0:
                continue
            left = j - 1 if j > 0 and inverse[i, j - 1] > 0 else j
            right = j + 1 if j + 1 < width and inverse[i, j + 1] > 0 else j
            top = i - 1 if i > 0 and inverse[i - 1, j] > 0 else i
            bottom = i + 1 if i + 1 < height and inverse[i + 1, j] > 0 else i
            steps = (right - left) * (bottom - top)
            if steps > 0:
                du, dv = rays[i, right] - rays[i, left], rays[bottom, j] - rays[top, j]
                volume = (
                    rays[i, j, 0] * (du[1] * dv[2] - du[2] * dv[1])
                    + rays[i, j, 1] * (du[2] * dv[0] - du[0] * dv[2])
                    + rays[i, j, 2] * (du[0] * dv[1] - du[1] * dv[0])
                )
                result[i, j] = abs(volume) / steps
    return result


@njit(cache=True, nogil=True, error_model='numpy')
def _area_moments(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    footprints: NDArray[np.float32],
    theta: NDArray[np.float64],
    tangents: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Sums (M + 1, 6) of a, a u, a v, a u^2, a u v, a v^2 of some rows; a is area over |theta|."""
    sums = np.zeros((len(theta), 6))
    for i in range(first, after):
        for j in range(labels.shape[1]):
            label = labels[i, j]
            if label == 0 or inverse[i, j] == 0:
                continue
            ray = ray_of(rays, pinhole, i, j)
            level = _product(theta[label], ray)
            if level * _FAR < inverse[i, j]:
                continue
            depth = 1 / level
            u = depth * _product(tangents[label, 0], ray)
            v = depth * _product(tangents[label, 1], ray)
            area = footprints[i, j] * depth * depth * depth
            total = sums[label]
            total[0] += area
            total[1] += area * u
            total[2] += area * v
            total[3] += area * u * u
            total[4] += area * u * v
            total[5] += area * v * v
    return sums


@njit(cache=True, inline='always')
def _product(vector: NDArray[np.float64], ray: tuple[float, float, float]) -> float:
    return vector[0] * ray[0] + vector[1] * ray[1] + vector[2] * ray[2]


@njit(cache=True, nogil=True)
def _limits(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    theta: NDArray[np.float64],
    axes: NDArray[np.float64],
    half: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Smallest and largest coordinates (M + 1, 2, 2) along the axes.

    `half` (3, 2) are the ways from the middle of a pixel to its right and to its lower side.
    """
    limits = np.empty((len(theta), 2, 2))
    limits[:, :, 0], limits[:, :, 1] = np.inf, -np.inf
    corners = 4 if half.any() else 1
    height, width = labels.shape
    for i in range(first, after):
        for j in range(width):
            label = labels[i, j]
            if label == 0 or inverse[i, j] == 0:
                continue
            # Rows of a pinhole camera are straight on the plane: the extremes lie at their ends.
            # Others may bend, but lie inside where all neighbours are of the region, too.
            if 0 < j < width - 1 and labels[i, j - 1] == label == labels[i, j + 1]:
                if corners > 1:
                    continue
                if 0 < i < height - 1 and labels[i - 1, j] == label == labels[i + 1, j]:
                    continue
            x, y, z = ray_of(rays, pinhole, i, j)
            for corner in range(corners):
                right, down = 1 - 2 * (corner & 1), 1 - (corner & 2)
                ray = (
                    x + half[0, 0] * right + half[0, 1] * down,
                    y + half[1, 0] * right + half[1, 1] * down,
                    z + half[2, 0] * right + half[2, 1] * down,
                )
                level = _product(theta[label], ray)
                if level * _FAR < inverse[i, j]:
                    continue
                for a in range(2):
                    value = _product(axes[label, a], ray) / level
                    limits[label, a, 0] = min(limits[label, a, 0], value)
                    limits[label, a, 1] = max(limits[label, a, 1], value)
    return limits
