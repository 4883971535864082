"""Area, principal axes and extents of regions on their planes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.blocks import BLOCK
from rangeseg_ros.core.sensing.marks import find_marked, no_marks
from rangeseg_ros.core.sensing.range_image import RangeImage

# A pixel's place on its plane is taken seriously up to this many times its measured range.
_FAR = 2.0


def areas_and_axes(
    labels: NDArray[np.uint16],
    image: RangeImage,
    theta: NDArray[np.float64],
    tangents: NDArray[np.float64],
    inner: NDArray[np.uint16],
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
    inner : (rows, columns) uint16
        Blocks inside regions, see `interior`.

    Returns
    -------
    area : (M + 1,) float64
        Of the pixels' footprints on the plane, square metres.
    major : (M + 1, 3) float64
        Unit vector in the plane of the largest second moment of the area, to the image's right.
    """
    arrays = labels, image.inverse, image.rays, _footprints(image), theta, tangents, inner
    upper, lower = map_halves(_area_moments, len(labels), *arrays)
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
    inner: NDArray[np.uint16],
) -> NDArray[np.float64]:
    """Rectangles around regions on their planes.

    Parameters
    ----------
    labels, image, theta
        As for `areas_and_axes`.
    axes : (M + 1, 2, 3) float64
        Directions of the rectangles' sides.
    inner
        As for `areas_and_axes`.

    Returns
    -------
    (M + 1, 2, 2) float64
        Smallest and largest coordinate along each axis, metres; of the corners of the pixels for
        a pinhole camera, of their centres otherwise. Not finite without pixels.
    """
    camera = image.camera
    half = (0.5 / camera.fx, 0.5 / camera.fy) if camera and camera.pinhole else (0.0, 0.0)
    arrays = labels, image.inverse, image.rays, theta, axes, inner
    upper, lower = map_halves(_limits, len(labels), *arrays, image.axes[:, :2] * half)
    # Smallest and largest.
    return np.stack([np.minimum(upper, lower)[..., 0], np.maximum(upper, lower)[..., 1]], axis=2)


def _footprints(image: RangeImage) -> NDArray[np.float32]:
    """|du x dv . r|, (H, W), of the rays r and their differences from pixel to pixel."""
    if image.camera and image.camera.pinhole:
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


@njit(cache=True, nogil=True)
def _area_moments(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    footprints: NDArray[np.float32],
    theta: NDArray[np.float64],
    tangents: NDArray[np.float64],
    inner: NDArray[np.uint16],
) -> NDArray[np.float64]:
    """Sums (M + 1, 6) of a, a u, a v, a u^2, a u v, a v^2: a is area over |theta|.

    A block inside a region counts as so many times its middle.
    """
    sums = np.zeros((len(theta), 6))
    width = labels.shape[1]
    for i in range(first, after):
        within, middle = inner[i // BLOCK], i % BLOCK == BLOCK // 2
        j = 0
        while j < width:
            label = int(labels[i, j])
            if label == 0:
                j += 1
                continue
            plane, across, along = theta[label], tangents[label, 0], tangents[label, 1]
            # In variables of their own: sums in an array go through memory for every pixel.
            one = su = sv = suu = suv = svv = 0.0
            while j < width and labels[i, j] == label:
                pixels = 1
                if within[j // BLOCK] > 0:
                    if not middle:
                        j = (j // BLOCK + 1) * BLOCK
                        continue
                    pixels = BLOCK * BLOCK
                    j = j // BLOCK * BLOCK + BLOCK // 2
                y = inverse[i, j]
                x0, x1, x2 = float(rays[i, j, 0]), float(rays[i, j, 1]), float(rays[i, j, 2])
                if pixels > 1:
                    # Of the four pixels in the middle, two will do.
                    x0 = (x0 + rays[i - 1, j - 1, 0]) / 2
                    x1 = (x1 + rays[i - 1, j - 1, 1]) / 2
                    x2 = (x2 + rays[i - 1, j - 1, 2]) / 2
                level = plane[0] * x0 + plane[1] * x1 + plane[2] * x2
                if y > 0 and level * _FAR >= y:
                    z = 1 / level
                    u = z * (across[0] * x0 + across[1] * x1 + across[2] * x2)
                    v = z * (along[0] * x0 + along[1] * x1 + along[2] * x2)
                    area = pixels * footprints[i, j] * z * z * z
                    au, av = area * u, area * v
                    one, su, sv = one + area, su + au, sv + av
                    suu, suv, svv = suu + au * u, suv + au * v, svv + av * v
                j += 1 if pixels == 1 else BLOCK // 2
            for entry, value in enumerate((one, su, sv, suu, suv, svv)):
                sums[label, entry] += value
    return sums


@njit(cache=True, nogil=True)
def _limits(
    first: int,
    after: int,
    labels: NDArray[np.uint16],
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    theta: NDArray[np.float64],
    axes: NDArray[np.float64],
    inner: NDArray[np.uint16],
    half: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Smallest and largest coordinates (M + 1, 2, 2) along the axes.

    `half` (3, 2) are the ways from the middle of a pixel to its right and to its lower side.
    """
    limits = np.empty((len(theta), 2, 2))
    limits[:, :, 0], limits[:, :, 1] = np.inf, -np.inf
    corners = 4 if half.any() else 1
    height, width = labels.shape
    # Rows of a pinhole camera are straight on the plane: the extremes lie at their ends. Others
    # may bend, but lie inside where all neighbours are of the region, too.
    outer = no_marks(width)
    places = np.empty(len(outer), np.intp)
    for i in range(first, after):
        if corners > 1:
            _find_ends(labels[i], labels[i], labels[i], outer)
        elif 0 < i < height - 1:
            _find_ends(labels[i], labels[i - 1], labels[i + 1], outer)
        else:
            outer[:width] = 1
        within = inner[i // BLOCK]
        for place in places[: find_marked(outer, 0, places)]:
            j = int(place)
            label = labels[i, j]
            if label == 0 or within[j // BLOCK] > 0 or inverse[i, j] == 0:
                continue
            plane = theta[label]
            for corner in range(corners):
                right, down = 1 - 2 * (corner & 1), 1 - (corner & 2)
                x = rays[i, j, 0] + half[0, 0] * right + half[0, 1] * down
                y = rays[i, j, 1] + half[1, 0] * right + half[1, 1] * down
                z = rays[i, j, 2] + half[2, 0] * right + half[2, 1] * down
                level = plane[0] * x + plane[1] * y + plane[2] * z
                if level * _FAR < inverse[i, j]:
                    continue
                for a in range(2):
                    axis = axes[label, a]
                    value = (axis[0] * x + axis[1] * y + axis[2] * z) / level
                    limits[label, a, 0] = min(limits[label, a, 0], value)
                    limits[label, a, 1] = max(limits[label, a, 1], value)
    return limits


@njit(cache=True, nogil=True)
def _find_ends(
    row: NDArray[np.uint16],
    above: NDArray[np.uint16],
    below: NDArray[np.uint16],
    ends: NDArray[np.uint8],
) -> None:
    """Mark the pixels of a row that have a neighbour of another region, or none."""
    # Views, of which the compiler takes many pixels at a time.
    last = len(row) - 1
    middle, left, right = row[1:], row, row[2:]
    upper, lower, inside = above[1:], below[1:], ends[1:]
    for j in range(last - 1):
        label = middle[j]
        inside[j] = (
            (label != left[j]) | (label != right[j]) | (label != upper[j]) | (label != lower[j])
        )
    ends[0] = ends[last] = 1
