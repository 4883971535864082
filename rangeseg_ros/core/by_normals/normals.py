"""Observed surface normals (thesis 5.7): unit vectors towards the sensor."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.moments import cofactors
from rangeseg_ros.core.sensing.range_image import RangeImage


def observed_normals(image: RangeImage, grid: Grid, config: Config) -> NDArray[np.float32]:
    """Normals by the method that `config` names.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    grid : Grid
        (H, W).
    config : Config
        `normals`, `normal_baseline`, `normal_radius` and `jump_edges` are read.

    Returns
    -------
    (H, W, 3) float32
        Unit vectors, NaN where undefined. With jump edges by plane deviation, which lie between
        pixels, that is also where a tangent crosses one.
    """
    if config.normals == 'plane_fit':
        return plane_fit(image, config.normal_radius)
    if config.normals == 'orthogonal_fit':
        return orthogonal_fit(image, config.normal_radius)
    normals = cross_product(image, config.normal_baseline)
    if config.jump_edges == 'plane':
        reach = config.normal_baseline
        broken = _within(grid.right <= 0, reach) | _within(grid.below.T <= 0, reach).T
        normals[broken] = np.nan
    return normals


def cross_product(image: RangeImage, baseline: int = 1) -> NDArray[np.float32]:
    """Cross product of the tangents between the neighbours of a pixel (thesis 5.7.1).

    Parameters
    ----------
    image : RangeImage
        (H, W).
    baseline : int
        Distance from the pixel to its left, right, upper and lower neighbour, pixels; 1 in the
        thesis. The noise of the direction falls in proportion.

    Returns
    -------
    (H, W, 3) float32
        NaN where the pixel or one of its neighbours was not measured or lies outside the image.
    """
    normals = np.empty(image.rays.shape, np.float32)
    run_rows(_cross_product, len(normals), image.inverse, image.rays, baseline, normals)
    return normals


@njit(cache=True, nogil=True)
def _cross_product(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    reach: int,
    normals: NDArray[np.float32],
) -> None:
    """Normals of some rows."""
    height, width = inverse.shape
    normals[first:after] = np.float32(np.nan)
    u, v = np.empty(3), np.empty(3)
    for i in range(max(first, reach), min(after, height - reach)):
        for j in range(reach, width - reach):
            left, right = inverse[i, j - reach], inverse[i, j + reach]
            upper, lower = inverse[i - reach, j], inverse[i + reach, j]
            if min(left, right, upper, lower, inverse[i, j]) <= 0:
                continue
            for c in range(3):
                u[c] = rays[i, j + reach, c] / right - rays[i, j - reach, c] / left
                v[c] = rays[i + reach, j, c] / lower - rays[i - reach, j, c] / upper
            x = u[2] * v[1] - u[1] * v[2]
            y = u[0] * v[2] - u[2] * v[0]
            z = u[1] * v[0] - u[0] * v[1]
            facing = x * rays[i, j, 0] + y * rays[i, j, 1] + z * rays[i, j, 2]
            length = math.sqrt(x * x + y * y + z * z)
            if length > 0 and facing != 0:
                scale = -math.copysign(1 / length, facing)
                normals[i, j, 0] = x * scale
                normals[i, j, 1] = y * scale
                normals[i, j, 2] = z * scale


def plane_fit(image: RangeImage, radius: int = 2) -> NDArray[np.float32]:
    """Plane through a window of least squares in inverse range (thesis 5.7.2).

    That is where the noise of structured light and stereo is constant; `orthogonal_fit` is of
    distances in space. The plane n . p + d = 0 is linear in inverse range, (-n/d) . ray = inverse,
    so that the sums of the normal equations are box filters over the image.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    radius : int
        The window has 2 radius + 1 rows and columns.

    Returns
    -------
    (H, W, 3) float32
        NaN where the window holds a pixel that was not measured or lies outside the image.
    """
    valid = image.valid
    a, b, c = (np.where(valid, ray, 0) for ray in cv2.split(image.rays.astype(np.float64)))
    w = image.inverse.astype(np.float64)
    aa, ab, ac, bb, bc, cc = (
        _means(p, radius) for p in (a * a, a * b, a * c, b * b, b * c, c * c)
    )
    aw, bw, cw = (_means(p, radius) for p in (a * w, b * w, c * w))
    aaa, aab, aac, abb, abc, acc, _ = cofactors(aa, ab, ac, bb, bc, cc)
    # Cramer's rule, without the determinant: the result is normalised anyhow.
    normal = np.stack(
        [
            aaa * aw + aab * bw + aac * cw,
            aab * aw + abb * bw + abc * cw,
            aac * aw + abc * bw + acc * cw,
        ],
        axis=-1,
    )
    normal[~_complete(valid, radius)] = np.nan
    return _towards_sensor(normal, image)


def orthogonal_fit(image: RangeImage, radius: int = 2) -> NDArray[np.float32]:
    """Plane through a window of least orthogonal distances to its points (thesis 5.7.2).

    The eigenvector of the smallest eigenvalue of the points' covariance. Parameters and result as
    for `plane_fit`.
    """
    valid = image.valid
    # About their mean, so that the products of coordinates keep their digits.
    points = image.points.astype(np.float64)
    points = np.where(valid[..., None], points - points[valid].mean(axis=0), 0)
    mean = np.stack([_means(points[..., k], radius) for k in range(3)], axis=-1)
    covariance = np.empty((*valid.shape, 3, 3))
    for a in range(3):
        for b in range(a + 1):
            product = _means(points[..., a] * points[..., b], radius)
            covariance[..., a, b] = product - mean[..., a] * mean[..., b]
    complete = _complete(valid, radius)
    normal = np.full(points.shape, np.nan)
    # Eigenvalues ascend; only the lower triangle is read.
    normal[complete] = np.linalg.eigh(covariance[complete])[1][..., 0]
    return _towards_sensor(normal, image)


def _means(values: NDArray[np.float64], radius: int) -> NDArray:
    """Means over windows, as if 0 outside the image."""
    size = 2 * radius + 1, 2 * radius + 1
    return cv2.boxFilter(values, cv2.CV_64F, size, borderType=cv2.BORDER_CONSTANT)


def _complete(valid: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    """Pixels whose window lies in the image and was measured throughout."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    inside = cv2.erode(
        valid.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    return inside > 0


def _towards_sensor(normals: NDArray, image: RangeImage) -> NDArray[np.float32]:
    """Unit vectors against the rays; NaN for vectors without a direction."""
    length = np.sqrt(np.einsum('ijk,ijk->ij', normals, normals))
    facing = np.einsum('ijk,ijk->ij', normals, image.rays)
    with np.errstate(divide='ignore', invalid='ignore'):
        scale = np.where(length > 0, -np.sign(facing) / length, np.nan)
    scale[scale == 0] = np.nan
    return (normals * scale[..., None]).astype(np.float32)


def _within(edges: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Pixels (H, W) with an edge of (H, W-1) among the `reach` to their left or right."""
    framed = np.pad(edges, ((0, 0), (reach, reach)))
    kernel = np.ones((1, 2 * reach), np.uint8)
    near = cv2.dilate(framed.astype(np.uint8), kernel, anchor=(reach, 0))
    return near[:, reach : reach + edges.shape[1] + 1] > 0
